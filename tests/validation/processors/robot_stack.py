"""The layers around a policy on the processor that runs this: controllers, envelope, deadline, updates.

Usage: python robot_stack.py -o FILE.npz [--steps STEPS] [--bundles FOLDER]

Writes the actions of each controller, the commands of each robot's envelope under attack with the largest excess over
its limits, and, with bundles (``_stack_bundles.py``), what was counted of deadlines and updates. Needs numpy; with
bundles an engine, too.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

TESTS = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(TESTS), str(TESTS / "runtime" / "control"), str(TESTS / "validation" / "envelope")]

import _delays  # noqa: E402
import envelope_trials  # noqa: E402
from _numbered import MOVES, spec_of  # noqa: E402

from vlatool.errors import DeadlineMissed, VlatoolError  # noqa: E402
from vlatool.runtime.control import build_controller  # noqa: E402
from vlatool.runtime.envelope import robot_names  # noqa: E402

CONTROLLERS = (
    ("chunked", 0), ("late", 5), ("asynchronous", 5), ("rtc", 0), ("rtc", 3), ("rtc", 8), ("temporal_ensemble", 0),
    ("interpolation:factor=3", 0), ("interpolation:factor=3:method=minimum_jerk", 0),
)  # fmt: skip
MODES = ("delta", "velocity", "absolute")
DEADLINE_MS, LONG_MS = 1_000.0, 600_000.0
"""A deadline that is missed, and one that an emulated inference keeps."""
STOPS = 3
TICKS = 3
LAXEST = {"runs": 2, "latency_ms": 0, "memory_mb": 0, "first_run_s": 600, "seconds": 0}
"""Conditions of a deployment that an emulated processor keeps: nothing of time or memory."""


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2000, help="of each robot and mode; no robot when 0")
    parser.add_argument("--bundles", type=Path)
    given = parser.parse_args()
    given.output.parent.mkdir(parents=True, exist_ok=True)
    found = dict(actions()) | (dict(commands(given.steps)) if given.steps else {})
    if given.bundles is not None:
        found |= {"deadline": deadlines(given.bundles / "endless"), "updates": updates(given.bundles)}
    np.savez(given.output, **found)


def actions() -> Iterator[tuple[str, Any]]:
    """Yield the name of a controller, and the actions that it takes of a policy whose chunks do not join."""
    for (name, delay), mode in ((each, mode) for each in CONTROLLERS for mode in MODES):
        policy = _delays.Path(spec_of(8, 4, action=replace(MOVES, mode=mode)))
        policy.error = 0.3
        player = build_controller(policy, [name] if delay == 0 else [f"{name}:delay={delay}"])
        yield f"actions {name} {delay} {mode}", np.stack([player.act({"t": step}) for step in range(100)])


def commands(steps: int) -> Iterator[tuple[str, Any]]:
    """Yield a robot and its mode, and what its envelope sent from the last start; at the end the largest excess."""
    worst = 0.0
    for name, mode in envelope_trials.cases(robot_names()):
        robot, excess = envelope_trials.attacked(name, mode, steps, 1)
        worst = max(worst, *excess.values())
        yield f"commands {name} {mode}", np.array(robot.sent)
    yield "excess", np.array([max(worst, 0.0)])


def deadlines(bundle: Path) -> Any:
    """Return how often a graph without end was stopped in time, and how often the policy was right afterwards."""
    from vlatool.bundle.bundle import Bundle
    from vlatool.runtime import Policy
    from vlatool.runtime.control.deadline import Deadline

    deadline = Deadline(Policy.open(Bundle.open(bundle), threads=1), LONG_MS)
    stopped = right = 0
    for _ in range(STOPS):
        deadline.deadline_ms, begin = DEADLINE_MS, time.monotonic()
        try:
            deadline.infer({"x": [1, 2], "trips": [2**62]})
        except DeadlineMissed:
            stopped += time.monotonic() - begin < 2 * DEADLINE_MS / 1e3
        while deadline.busy:
            time.sleep(0.01)
        deadline.deadline_ms = LONG_MS
        right += deadline.infer({"x": [1, 2], "trips": [3]}).chunk.tolist() == [[-1, -2]]
    deadline.close()
    return np.array([stopped, right])


def updates(bundles: Path) -> Any:
    """Return what a robot acted by, and which slot was active, through deployments, a trial, a crash and a rollback."""
    from vlatool.deployment.deploy import Conditions, deploy, roll_back
    from vlatool.deployment.slot_policy import SlotPolicy
    from vlatool.deployment.store import Store

    seen: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "store")
        for name in ("one", "two"):
            deploy(store, bundles / name, Conditions(ticks=TICKS, **LAXEST), lambda *_: None)
            with SlotPolicy(store, threads=1) as policy:
                seen += [float(policy.infer({"x": [1.0, 2.0]}).chunk[0, 0]) for _ in range(TICKS)]
                policy.wait()
                seen.append(float(policy.on_trial))
        roll_back(store)
        for refused in ("wrong", "one"):  # a golden action that the graph does not give; the active bundle again
            try:
                deploy(store, bundles / refused, Conditions(**LAXEST), lambda *_: None)
                seen.append(1.0)
            except VlatoolError:
                seen.append(0.0)
        with SlotPolicy(store, threads=1) as policy:
            seen.append(float(policy.infer({"x": [1.0, 2.0]}).chunk[0, 0]))
    return np.array(seen)


if __name__ == "__main__":
    main()
