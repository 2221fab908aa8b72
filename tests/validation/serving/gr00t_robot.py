"""A robot of GR00T: 40 lines that speak its protocol with ZeroMQ and MessagePack, as GR00T's client does.

python gr00t_robot.py tcp://127.0.0.1:5555 OBSERVATIONS.npz ACTIONS.npz [KEY]
"""

import io
import sys
import time

import msgpack
import numpy as np
import zmq


def encode(value):
    stream = io.BytesIO()
    np.save(stream, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": stream.getvalue()}


def decode(value):
    return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False) if "__ndarray_class__" in value else value


def call(endpoint, **data):
    socket.send(
        msgpack.packb({"endpoint": endpoint, "data": data, "api_token": key[0] if key else None}, default=encode)
    )
    return msgpack.unpackb(socket.recv(), object_hook=decode)


url, source, target, *key = sys.argv[1:]
socket = zmq.Context().socket(zmq.REQ)
socket.connect(url)
with np.load(source) as stored:
    columns = {name: stored[name] for name in stored.files}
assert call("ping")["status"] == "ok"
(action,) = call("get_modality_config")["action"]["as_json"]["modality_keys"]
chunks, times = [], []
for number in range(len(next(iter(columns.values())))):
    values = {
        name: [[str(rows[number])]] if rows.dtype.kind == "U" else rows[number][None, None]
        for name, rows in columns.items()
    }
    began = time.perf_counter()
    chunks.append(call("get_action", observation=values, options=None)[0][action][0])
    times.append((time.perf_counter() - began) * 1e3)
np.savez(target, chunks=np.stack(chunks), times=times)
