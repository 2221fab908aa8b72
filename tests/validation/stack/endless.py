"""Graphs that never end are stopped at the deadline, and one node that cannot be stopped is not waited for.

    python tests/validation/stack/endless.py --times 100

A Loop of 2^62 trips in ONNX Runtime, then the same graph with 3 trips; and one MaxPool that takes hours.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "runtime"))
from _written import ENDLESS, X, written
from test_first_run_limits import ONE_NODE

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DeadlineMissed
from vlatool.runtime import Policy
from vlatool.runtime.control.deadline import Deadline

DEADLINE_MS, QUICK_MS = 20.0, 10_000.0
LOOP = ENDLESS.replace("(float[1,2] x) =>", "(float[1,2] x, int64[1] trips) =>").replace(
    "int64 trips = {4611686018427387904}, ", ""
)


def opened(folder: str, text: str, **more: Any) -> Policy:
    """Open a bundle of one graph that is written as text."""
    return Policy.open(written(Path(folder) / "bundle", text, **more), threads=1)


def endless(times: int) -> dict[str, Any]:
    """Return how often a graph without end was stopped, and how often it answered afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        deadline = Deadline(opened(folder, LOOP, inputs=(X, TensorSpec("trips", (1,), "int64"))), DEADLINE_MS)
        answers, ends, alive, threads = [], [], 0, set()
        for _ in range(times):
            answers.append(_missed_ms(deadline, {"x": [1, 2], "trips": [2**62]}))
            ends.append(_free_ms(deadline))
            threads.add(threading.active_count())
            deadline.deadline_ms = QUICK_MS
            alive += deadline.infer({"x": [1, 2], "trips": [3]}).chunk.tolist() == [[-1, -2]]
            deadline.deadline_ms = DEADLINE_MS
        deadline.close()
    return {"stopped": len(answers), "right afterwards": alive, "answer ms": answers, "free after ms": ends,
            "threads": sorted(threads)}  # fmt: skip


def one_node(ticks: int) -> dict[str, Any]:
    """Return how long control steps took while a node computed that cannot be stopped."""
    with tempfile.TemporaryDirectory() as folder:
        deadline = Deadline(opened(folder, ONE_NODE), DEADLINE_MS)
        answers = [_missed_ms(deadline, {"x": [1, 2]}) for _ in range(ticks)]
        return {"answered": len(answers), "answer ms": answers, "busy": deadline.busy,
                "threads": [threading.active_count()]}  # fmt: skip


def _missed_ms(deadline: Deadline, observation: Any) -> float:
    """Return the time of an inference that misses its deadline."""
    begin = time.monotonic()
    try:
        deadline.infer(observation)
    except DeadlineMissed:
        return (time.monotonic() - begin) * 1e3
    raise SystemExit("an inference without end has ended")


def _free_ms(deadline: Deadline) -> float:
    begin = time.monotonic()
    while deadline.busy:
        time.sleep(0.0005)
    return (time.monotonic() - begin) * 1e3


def main() -> None:
    """Print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=100)
    times = parser.parse_args().times
    for title, found in (("a loop of 2^62 trips", endless(times)), ("one node of hours", one_node(times))):
        print(title)
        for name, value in found.items():
            if name.endswith("ms"):
                value = f"p50 {np.median(value):.2f}, max {max(value):.2f}"
            print(f"  {name}: {value}")


if __name__ == "__main__":
    main()
