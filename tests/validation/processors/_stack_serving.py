"""The rows of ``arm64.py`` about serving: ``vlatool serve`` is the board's program, its clients are this host's."""

from __future__ import annotations

import importlib.util
import math
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from _asked import CRASHED, ROOT
from _verdicts import Difference, Row

sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests/validation/serving")]

ASKED, FRAMES = 20, 200
"""Observations, and malformed frames, for each protocol."""
NEEDS = ("grpc", "msgpack", "onnx", "psutil", "torch", "websockets", "zmq")
"""What the clients need here."""
INPUT, NAME = "q", "observation.state"
"""The bundle's input, and what clients call it: what LeRobot calls a robot's state."""
PROTOCOLS = ("openpi", "gr00t", "lerobot")
START_S, ANSWER_S = 600.0, 60.0
"""Time in which an emulated server says its addresses, and in which it answers."""
WRONG = Difference(math.inf, math.inf)
SAME = Difference(0.0, 0.0)


class ServeError(Exception):
    """A server that says no addresses."""


def serving_rows(where: tuple[str, ...], python: Path, folder: Path) -> list[Row]:
    """Return a row for the actions of each protocol, for each one's malformed frames, and for the server's end.

    Args:
        where: The board.
        python: Its Python with vlatool and the packages that ``vlatool serve`` needs.
        folder: Where the bundle is made; it must not exist.
    """
    if missing := [name for name in NEEDS if importlib.util.find_spec(name) is None]:
        return [Row(where, "vlatool serve", None, 0.0, skipped=f"needs {', '.join(missing)}")]
    from _arm_bundle import arm_bundle
    from malformed_frames import lerobot_classes

    from vlatool.runtime import load

    bundle = arm_bundle(folder).path
    seen = np.random.default_rng(0).uniform(-0.2, 0.2, (ASKED, 7)).astype(np.float32)
    policy = load(bundle, threads=1)
    wanted = np.stack([policy.infer({INPUT: each}).chunk for each in seen])
    rows: list[Row] = []
    try:
        with lerobot_classes(), board_serves([str(python), "-m", "vlatool"], bundle) as (addresses, ended):
            for protocol, address in addresses.items():
                rows.append(_row(where, f"serve: {protocol}", answered, protocol, address, seen, wanted))
                rows.append(_row(where, f"serve: {protocol}, malformed", attacked, protocol, address, seen, wanted))
            rows.append(_row(where, "serve: end at SIGTERM", ended))
    except ServeError as error:
        rows.append(Row(where, "vlatool serve", None, 0.0, CRASHED, note=str(error)))
    return rows


def _row(where: tuple[str, ...], title: str, measure: Callable[..., Difference], *given: Any) -> Row:
    try:
        return Row(where, title, measure(*given), 0.0)
    except Exception as error:  # whatever a client raises, the table says it
        return Row(where, title, None, 0.0, type(error).__name__, note=str(error))


@contextmanager
def board_serves(command: Sequence[str], bundle: Path) -> Iterator[tuple[dict[str, str], Callable[[], Difference]]]:
    """Serve a bundle in a process of its own.

    Args:
        command: Words that start vlatool.
        bundle: What is served.

    Yields:
        The address of each protocol, and a function that ends the server and says whether it left with 0.

    Raises:
        ServeError: when it ends before, or does not say them in time.
    """
    words = [*command, "serve", str(bundle), "--protocol", ",".join(PROTOCOLS), "--port", "0", "--threads", "1",
             "--deadline-ms", f"{ANSWER_S * 1e3:.0f}", "--map", f"{INPUT}={NAME}"]  # fmt: skip
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(words, stdout=said, stderr=subprocess.STDOUT, cwd=ROOT)

        def end() -> Difference:
            process.send_signal(signal.SIGTERM)
            return SAME if process.wait(ANSWER_S) == 0 else WRONG

        try:
            yield _addresses(process, said), end
        finally:
            with suppress(subprocess.TimeoutExpired):
                process.kill()
                process.wait(10)


def _addresses(process: subprocess.Popen[Any], said: Any) -> dict[str, str]:
    due = time.monotonic() + START_S
    while True:
        said.seek(0)
        text = said.read()
        found = dict(re.findall(r"^(\w+): (\S+)$", text, re.MULTILINE))
        if found.keys() >= set(PROTOCOLS):
            return {protocol: found[protocol] for protocol in PROTOCOLS}
        if process.poll() is not None or time.monotonic() > due:
            raise ServeError(f"It does not serve: {text.strip()[-300:]}")
        time.sleep(0.2)


def apart(got: Any, wanted: Any) -> Difference:
    """Return the largest difference of chunks, (N, T, A), from those of this host."""
    if got.shape != wanted.shape or not np.isfinite(got).all():
        return WRONG
    worst = float(np.abs(got - wanted).max())
    return Difference(worst, worst)


def answered(protocol: str, address: str, seen: Any, wanted: Any) -> Difference:
    """Return how far the chunks that a server sends are from those of this host, (N, T, A)."""
    return apart(asked(protocol, address, seen), wanted)


def asked(protocol: str, address: str, seen: Any) -> Any:
    """Return the chunks, (N, T, A), that a server sends for joint positions, (N, 7)."""
    return np.stack(list({"openpi": _openpi, "gr00t": _gr00t, "lerobot": _lerobot}[protocol](address, seen)))


def _openpi(address: str, seen: Any) -> Iterator[Any]:
    from websockets.sync.client import connect

    from vlatool.runtime.openpi_messages import pack, unpack

    with connect(address, compression=None, proxy=None) as connection:
        connection.recv(ANSWER_S)
        for row in seen:
            connection.send(pack({NAME: row}))
            answer = connection.recv(ANSWER_S)
            if isinstance(answer, str):
                raise RuntimeError(answer)
            yield unpack(answer)["actions"]


def _gr00t(address: str, seen: Any) -> Iterator[Any]:
    """The 40 lines that speak its protocol, in a process of their own."""
    from clients import HERE

    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "seen.npz"), Path(folder, "done.npz")
        np.savez(source, **{NAME: seen})
        words = [sys.executable, HERE / "gr00t_robot.py", address, source, target]
        subprocess.run(words, check=True, timeout=10 * ANSWER_S)
        with np.load(target) as done:
            yield from done["chunks"]


def _lerobot(address: str, seen: Any) -> Iterator[Any]:
    import grpc
    from _arm_bundle import JOINTS
    from _lerobot import RemotePolicyConfig, TimedObservation, pickled, unpickled

    from vlatool.serving._protobuf import bytes_field, fields

    path = "/transport.AsyncInference/"
    features = {NAME: {"dtype": "float32", "shape": (len(JOINTS),), "names": list(JOINTS)}}
    with grpc.insecure_channel(address) as channel:
        observe = channel.stream_unary(f"{path}SendObservations")
        channel.unary_unary(f"{path}Ready")(b"", timeout=ANSWER_S)
        setup = bytes_field(1, pickled(RemotePolicyConfig("act", "x", features, 3)))
        channel.unary_unary(f"{path}SendPolicyInstructions")(setup, timeout=ANSWER_S)
        for number, row in enumerate(seen):
            values = {name: float(value) for name, value in zip(JOINTS, row, strict=True)}
            message = pickled(TimedObservation(1.0, number, values, must_go=True))
            observe(iter([b"\x08\x03" + bytes_field(2, message)]), timeout=ANSWER_S)
            answer = channel.unary_unary(f"{path}GetActions")(b"", timeout=ANSWER_S)
            actions = unpickled(fields(answer, {1: bytes})[1])
            yield np.array([each.action.tolist() for each in actions], np.float32)


def attacked(protocol: str, address: str, seen: Any, wanted: Any) -> Difference:
    """Send malformed frames, each of which has to be answered or refused; return how wrong the next actions are."""
    import malformed_frames
    from _malformed import malformed

    client = malformed_frames.PROTOCOLS[protocol](address)
    try:
        for frame in malformed(client.frames, FRAMES, 3):
            client.send(frame)
    finally:
        client.close()
    malformed_frames.garbage(int(address.rpartition(":")[2]), 20)
    return answered(protocol, address, seen[:2], wanted[:2])
