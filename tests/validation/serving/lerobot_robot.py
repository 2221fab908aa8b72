"""A robot of LeRobot: its own stubs, classes and transport (lerobot 0.6.1 with grpcio and protobuf 6).

    python lerobot_robot.py 127.0.0.1:8080 OBSERVATIONS.npz ACTIONS.npz [TENSORS]

Vectors are sent as a robot's single elements, ``NAME.0``, ``NAME.1``, ..., pictures under their names, a text as the
task. With TENSORS, pictures are tensors of torch.
"""

import pickle  # noqa: TID251 - what the client does
import sys
import time

import grpc
import numpy as np
import torch
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedAction, TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import grpc_channel_options, send_bytes_in_chunks

address, source, target, *tensors = sys.argv[1:]
with np.load(source) as stored:
    columns = {name: stored[name] for name in stored.files}
vectors = {name: rows for name, rows in columns.items() if rows.ndim == 2}
pictures = {name: rows for name, rows in columns.items() if rows.ndim == 4}
texts = {"task": rows for rows in columns.values() if rows.dtype.kind == "U"}  # noqa: B035 - there is one at most
elements = {name: [f"{name}.{index}" for index in range(rows.shape[1])] for name, rows in vectors.items()}
features = {
    f"observation.{name}": {"dtype": "float32", "shape": rows.shape[1:], "names": elements[name]}
    for name, rows in vectors.items()
}
features |= {
    f"observation.images.{name}": {"dtype": "image", "shape": rows.shape[1:]} for name, rows in pictures.items()
}
stub = services_pb2_grpc.AsyncInferenceStub(grpc.insecure_channel(address, grpc_channel_options()))
stub.Ready(services_pb2.Empty())
config = RemotePolicyConfig("act", "user/model", features, 1000)
stub.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(config)))
chunks, times = [], []
for number in range(len(next(iter(columns.values())))):
    values = {
        key: float(row) for name, rows in vectors.items() for key, row in zip(elements[name], rows[number], strict=True)
    }
    values |= {name: torch.from_numpy(rows[number]) if tensors else rows[number] for name, rows in pictures.items()}
    values |= {name: str(rows[number]) for name, rows in texts.items()}
    began = time.perf_counter()
    seen = pickle.dumps(TimedObservation(time.monotonic(), number, values, must_go=True))
    stub.SendObservations(send_bytes_in_chunks(seen, services_pb2.Observation))
    actions = pickle.loads(stub.GetActions(services_pb2.Empty()).data)
    times.append((time.perf_counter() - began) * 1e3)
    assert all(
        type(action) is TimedAction and action.get_timestep() == number + index for index, action in enumerate(actions)
    )
    chunks.append(torch.stack([action.get_action() for action in actions]).numpy())
np.savez(target, chunks=np.stack(chunks), times=times)
