"""What a robot does, with nothing but numpy and one engine: load a bundle, act once, say what it cost, act late.

Usage: python tests/robot/controller.py BUNDLE [--max-ms 400] [--max-mb 130]

Every package that a robot does not have is blocked, so that an import of one would fail. Prints two lines and exits 1
when a limit is broken, or the controller ``late``, found by its name, does not act as it says.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

BLOCKED = {
    "torch",
    "onnx",
    "onnxscript",
    "onnx_ir",
    "pydantic",
    "typer",
    "rich",
    "yaml",
    "psutil",
    "jinja2",
    "scipy",
    "tokenizers",
}


class Absent:
    """An import hook that makes packages look uninstalled."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        """Refuse the blocked packages."""
        if name.partition(".")[0] in BLOCKED:
            raise ImportError(f"{name} is not on a robot", name=name)


def peak_mb() -> float:
    """Return the largest resident set of this process in MB (10^6 bytes)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024 / 1e6


def main() -> None:
    """Load, act, report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("bundle")
    parser.add_argument("--max-ms", type=float, default=float("inf"))
    parser.add_argument("--max-mb", type=float, default=float("inf"))
    given = parser.parse_args()
    sys.meta_path.insert(0, Absent())  # type: ignore[arg-type]
    start = time.perf_counter()
    import vlatool.runtime

    imported = time.perf_counter()
    policy = vlatool.load(given.bundle, threads=1)
    loaded = time.perf_counter()
    from vlatool.runtime.golden import load_golden

    golden = load_golden(policy.bundle)
    if golden is None:
        sys.exit("the bundle has no golden observation")
    before = time.perf_counter()
    action = policy.infer(golden[0], noise=golden[1])
    done = time.perf_counter()
    total_ms = 1e3 * (done - start)
    import onnxruntime

    print(
        f"python {sys.version.split()[0]}, onnxruntime {onnxruntime.__version__}:"
        f" import {1e3 * (imported - start):.0f} ms"
        f" + load {1e3 * (loaded - imported):.0f} ms + first action {1e3 * (done - before):.1f} ms = {total_ms:.0f} ms,"
        f" peak RSS {peak_mb():.0f} MB, chunk {action.chunk.shape}"
    )
    if total_ms > given.max_ms or peak_mb() > given.max_mb:
        sys.exit(f"a limit is broken: {given.max_ms:g} ms, {given.max_mb:g} MB")
    print(drive_late(policy, golden[0]))


def drive_late(policy: Any, observation: Any) -> str:
    """Act with ``late`` through three chunks, each of an inference that takes two control steps."""
    import numpy as np

    from vlatool.runtime.control import build_controller
    from vlatool.runtime.interface import Controller, Policy

    spec, delay = policy.spec, 2
    executed = spec.execute or spec.chunk
    late = build_controller(policy, ["late"], delay)
    assert isinstance(policy, Policy)
    assert isinstance(late, Controller)
    policy.reset(3)
    chunks = [policy.infer(observation).chunk for _ in range(3)]
    late.reset(3)
    acted = [(late.act(observation), late.fresh) for _ in range(2 * (executed + delay) + 1)]
    begins = [step for step, (_, fresh) in enumerate(acted) if fresh]
    assert begins == [0, executed + delay, 2 * (executed + delay)], begins
    left_out = min(delay, spec.chunk - executed)
    for step, chunk, first in zip(begins, chunks, (0, left_out, left_out)):  # noqa: B905
        np.testing.assert_array_equal(acted[step][0], chunk[first])
    return f"late: {len(acted)} control steps, chunks from {begins}, {sys.modules[type(late).__module__].__file__}"


if __name__ == "__main__":
    main()
