"""A robot of openpi: its own client, unchanged, in an environment with ``openpi-client`` and ``typing_extensions``.

    python openpi_robot.py ws://127.0.0.1:8000 OBSERVATIONS.npz ACTIONS.npz [KEY]

Writes the chunks, (N, T, A), and the milliseconds of each request, (N,).
"""

import sys
import time

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

url, source, target, *key = sys.argv[1:]
with np.load(source) as stored:
    columns = {name: stored[name] for name in stored.files}
client = WebsocketClientPolicy(url, api_key=key[0] if key else None)
chunks, times = [], []
for number in range(len(next(iter(columns.values())))):
    values = {name: str(rows[number]) if rows.dtype.kind == "U" else rows[number] for name, rows in columns.items()}
    began = time.perf_counter()
    chunks.append(client.infer(values)["actions"])
    times.append((time.perf_counter() - began) * 1e3)
np.savez(target, chunks=np.stack(chunks), times=times)
