"""Clients of others drive ``vlatool serve``: openpi's own, 40 lines of GR00T's protocol, LeRobot's own stubs.

    python tests/validation/serving/clients.py BUNDLE --openpi PYTHON --lerobot PYTHON
    python tests/validation/serving/clients.py --small --openpi PYTHON --lerobot PYTHON    # what serving adds

PYTHON has ``openpi-client`` (which brings NumPy 1) and ``typing_extensions``, or ``lerobot`` 0.6.1 with grpcio and
protobuf 6. Without them their clients are left out. Each client gets the actions for the same observations, and they
are compared, bit for bit, with those of the bundle in this process; the time of its requests is compared with the time
of the inference alone. The small bundle is one addition, so that almost all of a request's time is what serving adds.
"""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from _arm_bundle import arm_bundle

from vlatool.bundle.spec import PolicySpec
from vlatool.runtime import load

HERE = Path(__file__).parent
KEY = "0123456789abcdef-a-key-for-a-trial"


def observations(spec: PolicySpec, count: int, seed: int = 0) -> dict[str, Any]:
    """Random observations, a row for each: pictures, vectors, the same sentence."""
    random = np.random.default_rng(seed)
    columns: dict[str, Any] = {}
    for tensor in spec.inputs:
        shape = (count, *tensor.observation.shape[1:])
        if tensor.kind == "text":
            columns[tensor.name] = np.array(["press the button"] * count)
        elif tensor.observation.dtype == "uint8":
            columns[tensor.name] = random.integers(0, 256, shape, np.uint8)
        else:
            columns[tensor.name] = random.uniform(-0.2, 0.2, shape).astype(np.float32)
    return columns


def names_of(protocol: str, spec: PolicySpec) -> list[str]:
    """The words of ``--map`` for the names that the client uses."""
    if protocol != "lerobot":
        return []
    words = []
    for tensor in spec.inputs:
        picture = tensor.observation.dtype == "uint8"
        name = "task" if tensor.kind == "text" else f"observation.{'images.' if picture else ''}{tensor.name}"
        words += ["--map", f"{tensor.name}={name}"]
    return words


class Served:
    """A bundle that a process of its own serves, until the end of a block."""

    def __init__(self, bundle: Path, protocol: str, *words: str) -> None:
        self.line = [sys.executable, "-m", "vlatool", "serve", str(bundle), "--protocol", protocol, "--port", "0",
                     "--threads", "1", "--deadline-ms", "5000", *words]  # fmt: skip

    def __enter__(self) -> str:
        self.process = subprocess.Popen(self.line, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        first = self.process.stdout.readline()
        match = re.match(r"\w+: (\S+)", first)
        assert match, f"it does not serve: {first}"
        return match[1]

    def __exit__(self, *_: object) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.rest, _unused = self.process.communicate(timeout=30)
        assert self.process.returncode == 0, self.process.returncode


def drive(bundle: Path, protocol: str, python: str, count: int, *more: str) -> dict[str, Any]:
    """Let a client ask for the actions of some observations; returns what came of it."""
    policy = load(bundle, threads=1)
    columns = observations(policy.spec, count)
    with tempfile.TemporaryDirectory() as folder:
        source, target, key = (Path(folder) / name for name in ("seen.npz", "done.npz", "key"))
        np.savez(source, **columns)
        key.write_text(KEY)
        keyed = protocol in ("openpi", "gr00t")
        words = [*names_of(protocol, policy.spec), *(["--key", str(key)] if keyed else [])]
        with Served(bundle, protocol, *words) as address:
            given = [address, str(source), str(target), *([KEY] if keyed else []), *more]
            subprocess.run([python, str(HERE / f"{protocol}_robot.py"), *given], check=True, timeout=600)
        with np.load(target) as done:
            chunks, times = done["chunks"], done["times"]
    bare, equal = [], 0
    for number in range(count):
        seen = {name: str(rows[number]) if rows.dtype.kind == "U" else rows[number] for name, rows in columns.items()}
        began = time.perf_counter()
        chunk = policy.infer(seen).chunk
        bare.append((time.perf_counter() - began) * 1e3)
        equal += np.array_equal(chunks[number], chunk)
    times_ms = {name: round(float(np.median(taken)), 3) for name, taken in (("request", times), ("infer here", bare))}
    return {
        "protocol": protocol,
        "observations": count,
        "actions as in this process": int(equal),
        "p50 in ms": times_ms,
    }


def main(words: Sequence[str] | None = None) -> None:
    """Run the clients that there are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path, nargs="?")
    parser.add_argument("--small", action="store_true", help="a bundle of one addition, made here")
    parser.add_argument("--openpi", default="", help="Python with openpi-client")
    parser.add_argument("--lerobot", default="", help="Python with lerobot and grpcio")
    parser.add_argument("--count", type=int, default=200)
    given = parser.parse_args(words)
    runs = [
        ("gr00t", sys.executable),
        ("openpi", given.openpi),
        ("lerobot", given.lerobot),
        ("lerobot", given.lerobot, "tensors"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        bundle = arm_bundle(Path(folder) / "arm").path if given.small else given.bundle
        for protocol, python, *more in runs:
            if python:
                print(*more, drive(bundle, protocol, python, given.count, *more), flush=True)


if __name__ == "__main__":
    main()
