"""What the whole stack adds to ONNX Runtime's own ``run()``, call by call in turn, in one process.

    python tests/validation/stack/overhead.py BUNDLE --pairs 20000

Deadline, fallback and telemetry are on, and the envelope of a robot with ``--robot``. Both calls of a pair get the same
observation; who goes first alternates. A pair counts where the stack infers.
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.runtime import load
from vlatool.runtime.stack import Fallback, Stack

SHARES = (50, 99, 99.9)


def differences(path: str, pairs: int, robot: str | None, deadline_ms: float | None) -> dict[str, np.ndarray]:
    """Return microseconds of the bare calls, of the stack's, and stack minus bare of each pair."""
    plain = load(path, threads=1, seed=0)
    spec = plain.spec
    hold = Fallback(start=np.zeros(spec.action.robot_width), neutral=spec.action.labels[-1] if spec.action.kind == "discrete"
                    else "")  # fmt: skip
    sink: deque[Any] = deque(maxlen=1000)
    limit = 0.9e3 / spec.rate if deadline_ms is None else deadline_ms
    stack = load(path, threads=1, seed=0, envelope=robot, deadline_ms=limit, fallback=hold, telemetry=sink.append)
    assert isinstance(stack, Stack)
    observations = observations_for(Bundle.open(path), 16)
    step = plain.program.steps[0]
    session = getattr(plain.program.sessions[step.graph], "_session")  # noqa: B009
    feeds = [{name: plain.encode(each)[value] for name, value in step.feeds.items()} for each in observations]
    calls = ((lambda index: session.run(None, feeds[index])), (lambda index: stack.act(observations[index])))
    taken: tuple[list[float], list[float]] = ([], [])
    for pair in range(pairs + 200):
        times, counts = [0.0, 0.0], True
        for kind in (0, 1) if pair % 2 else (1, 0):
            begin = time.perf_counter_ns()
            calls[kind](pair % len(observations))
            times[kind] = (time.perf_counter_ns() - begin) / 1e3
            counts &= kind == 0 or (stack.fresh and not sink[-1].missed)
        if pair >= 200 and counts:
            for kind in (0, 1):
                taken[kind].append(times[kind])
    bare, whole = map(np.array, taken)
    return {"bare run()": bare, "stack": whole, "stack minus bare, in pairs": whole - bare}


def main() -> None:
    """Print percentiles."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle")
    parser.add_argument("--pairs", type=int, default=20_000)
    parser.add_argument("--robot")
    parser.add_argument("--deadline-ms", type=float)
    options = parser.parse_args()
    for name, values in differences(options.bundle, options.pairs, options.robot, options.deadline_ms).items():
        shown = ", ".join(f"p{share:g} {value:.1f}" for share, value in zip(SHARES, np.percentile(values, SHARES)))
        print(f"{name}: {shown} us ({len(values)} pairs)")


if __name__ == "__main__":
    main()
