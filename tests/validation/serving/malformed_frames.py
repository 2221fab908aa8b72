"""Malformed frames, through sockets: no server falls, each goes on to serve, none grows.

    python tests/validation/serving/malformed_frames.py --frames 100000 [--protocol openpi gr00t lerobot]

A server of each protocol in this process gets damaged copies of valid frames. Those of openpi end their connection,
which is opened anew. Every 1,000 frames a valid request has to be answered rightly. Last, bytes that are not of the
protocol at all are sent to the port.
"""

from __future__ import annotations

import argparse
import contextlib
import pickle  # noqa: TID251 - what LeRobot's client sends
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import grpc
import msgpack
import numpy as np
import psutil
import zmq
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

sys.path.insert(0, str(Path(__file__).parents[2]))
from _episodes_policy import CountingPolicy
from _lerobot import RemotePolicyConfig, TimedObservation, with_modules
from _malformed import malformed

from vlatool.files.array_bytes import npy_bytes
from vlatool.runtime.openpi_messages import pack, unpack
from vlatool.serving import Access, Service
from vlatool.serving._protobuf import bytes_field, fields
from vlatool.serving.gr00t import Gr00tServer
from vlatool.serving.lerobot import LerobotServer
from vlatool.serving.openpi import OpenpiServer

STEP = np.float32([1])
CHECK_EVERY = 1000


class Openpi:
    """A client that sends anything."""

    server, frames = (
        OpenpiServer,
        (pack({"t": 1}), pack({"t": STEP, "image": np.zeros((4, 4, 3), np.uint8), "prompt": "go"})),
    )

    def __init__(self, address: str) -> None:
        self._address, self._connection = address, None

    def send(self, frame: bytes) -> str:
        """Send a frame; returns what came of it."""
        try:
            self._open().send(frame)
            answer = self._connection.recv(20)
        except ConnectionClosed as error:
            self._connection = None
            return f"closed {error.rcvd.code if error.rcvd else ''}"
        if isinstance(answer, str):
            self._connection.close()
            self._connection = None
        return "refused" if isinstance(answer, str) else "answered"

    def _open(self) -> Any:
        if self._connection is None:
            context = connect(self._address, compression=None, proxy=None)
            self._connection = context.__enter__()
            self._connection.recv(20)
        return self._connection

    def check(self) -> None:
        """Ask rightly."""
        self.close()
        self._open().send(self.frames[1])
        assert unpack(self._connection.recv(20))["actions"].shape == (3, 2)

    def close(self) -> None:
        """Go."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None


class Gr00t:
    """The same for GR00T."""

    server = Gr00tServer
    frames = (
        msgpack.packb({"endpoint": "ping"}), msgpack.packb({"endpoint": "reset", "data": {"options": {"seed": 3}}}),
        msgpack.packb({"data": {"observation": {"t": {"__ndarray_class__": True, "as_npy": npy_bytes(STEP)}}}}),
    )  # fmt: skip

    def __init__(self, address: str) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REQ)
        self._socket.connect(address)

    def send(self, frame: bytes) -> str:
        """Send a request; returns what came of it."""
        self._socket.send(frame)
        assert self._socket.poll(20_000), "there is no answer"
        answer = msgpack.unpackb(self._socket.recv())
        return "refused" if isinstance(answer, dict) and "error" in answer else "answered"

    def check(self) -> None:
        """Ask rightly."""
        assert self.send(self.frames[2]) == "answered"

    def close(self) -> None:
        """Go."""
        self._context.destroy(0)


class Lerobot:
    """The same for LeRobot: observations and instructions in turn."""

    server = LerobotServer

    def __init__(self, address: str) -> None:
        self._channel = grpc.insecure_channel(address)
        self._observe = self._channel.stream_unary("/transport.AsyncInference/SendObservations")
        self._turn = 0

    @property
    def frames(self) -> tuple[bytes, ...]:
        """Valid messages."""
        seen = pickle.dumps(
            TimedObservation(1.0, 3, {"a": 1.0, "image": np.zeros((4, 4, 3), np.uint8), "task": "go"}, True)
        )
        return b"\x08\x03" + bytes_field(2, seen), bytes_field(1, pickle.dumps(_instructions()))

    def send(self, frame: bytes) -> str:
        """Send a message; returns what came of it."""
        self._turn += 1
        try:
            if self._turn % 2:
                self._observe(iter([frame]), timeout=20)
            else:
                self._call("SendPolicyInstructions", frame)
        except grpc.RpcError as error:
            if error.code() is not grpc.StatusCode.INVALID_ARGUMENT:
                raise
            return "refused"
        return "answered"

    def _call(self, method: str, message: bytes = b"") -> bytes:
        return self._channel.unary_unary(f"/transport.AsyncInference/{method}")(message, timeout=20)

    def check(self) -> None:
        """Ask rightly."""
        self._call("Ready")
        self._call("SendPolicyInstructions", self.frames[1])
        self._observe(iter([self.frames[0]]), timeout=20)
        assert len(pickle.loads(fields(self._call("GetActions"), {1: bytes})[1])) == 3

    def close(self) -> None:
        """Go."""
        self._channel.close()


def _instructions() -> RemotePolicyConfig:
    return RemotePolicyConfig("act", "x", {"t": {"dtype": "float32", "shape": (1,), "names": ["a"]}}, 3)


PROTOCOLS: dict[str, Any] = {"openpi": Openpi, "gr00t": Gr00t, "lerobot": Lerobot}


@contextlib.contextmanager
def lerobot_classes() -> Iterator[None]:
    """Let pickle find LeRobot's classes."""
    with contextlib.contextmanager(with_modules)():
        yield


def garbage(port: int, count: int) -> int:
    """Send bytes of no protocol to a port, and hang up; returns how often."""
    for number, content in enumerate(
        malformed([b"GET / HTTP/1.1\r\n\r\n", b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x7f\x03"], count, seed=9)
    ):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 10) as plain:
            plain.sendall(content)
            plain.settimeout(0.01 if number % 10 == 0 else 0.0001)
            plain.recv(100)
    return count


def attack(
    protocol: str, frames: int, seed: int = 0, tell: Callable[[str], object] = lambda text: None
) -> dict[str, Any]:
    """Send malformed frames to a server; returns what came of them."""
    kind = PROTOCOLS[protocol]
    server = kind.server(Service(CountingPolicy()), Access(), 0)
    client = kind(server.start())
    outcomes: Counter[str] = Counter()
    began, before, process = time.monotonic(), 0.0, psutil.Process()
    try:
        for number, frame in enumerate(malformed(client.frames, frames, seed)):
            outcomes[client.send(frame)] += 1
            if number % CHECK_EVERY == 0:
                client.check()
            if number == min(frames // 4, 20_000):
                before = process.memory_info().rss / 1e6
            if number % 10_000 == 9_999:
                tell(f"{protocol}: {number + 1} frames, {process.memory_info().rss / 1e6:.0f} MB")
        strangers = garbage(server.port, max(10, frames // 100))
        client.check()
    finally:
        client.close()
        server.close()
    return {"protocol": protocol, "frames": frames, **outcomes, "other bytes": strangers, "crashes": 0,
            "MB grown since a quarter": round(process.memory_info().rss / 1e6 - before, 1),
            "seconds": round(time.monotonic() - began, 1)}  # fmt: skip


def main(words: Sequence[str] | None = None) -> None:
    """Attack the protocols in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--protocol", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    given = parser.parse_args(words)
    with lerobot_classes():
        for protocol in given.protocol:
            print(attack(protocol, given.frames, given.seed, print), flush=True)


if __name__ == "__main__":
    main()
