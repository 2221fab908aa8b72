"""Control steps with injected delays: each is answered by its deadline, and no late action is ever used.

    python tests/validation/stack/ticks.py --ticks 100000                  # by a clock that is moved: the logic
    python tests/validation/stack/ticks.py --ticks 100000 --real           # at 100 Hz: 17 minutes
    python tests/validation/stack/ticks.py --ticks 6000 --real --stubborn  # a policy that cannot be stopped

A policy takes 0 to 10 times the deadline, half of the time at most the deadline. The first number of an action says
which inference it is from. Times are from when a step was to begin, so a step that the machine begins late counts as
late; "waited" is that part, which the stack cannot change, and "beyond" the time beyond the deadline, or beyond the
call where that came after it.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from _fake_clock import FakeClock, FakeWorker
from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.interface import CHUNK, POLICY, Action
from vlatool.runtime.stack import Fallback, build_stack, prepare_process

HZ, DEADLINE_MS = 100.0, 5.0
ACTION = TensorSpec("a", (1, 1, 2), dtype="float64", labels=("x", "gripper"), mode="absolute")


class DelayedPolicy(NumberedPolicy):
    """Takes its time, unless it is stopped; remembers which inferences ended after their deadline."""

    def __init__(self, clock: Any, seed: int, stubborn: bool) -> None:
        super().__init__(spec_of(4, 2, ACTION, HZ))
        self.clock, self.stubborn, self.random = clock, stubborn, np.random.default_rng(seed)
        self.ended = threading.Event()
        self.late: set[int] = set()
        self.began = 0

    def delay_s(self) -> float:
        """Return 0 to 10 deadlines, half of the time at most one."""
        share = self.random.random()
        return DEADLINE_MS / 1e3 * (2 * share if share < 0.5 else 1 + 18 * (share - 0.5))

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        """Return the chunk of a control step after a delay."""
        delay, step, due = self.delay_s(), observation["t"], observation["due"]
        self.began += 1
        if isinstance(self.clock, FakeClock):
            self.clock.now += delay
        elif self.stubborn:
            time.sleep(delay)
        else:
            self.ended.wait(delay)
        rows = 10.0 * step + np.arange(self.spec.chunk)
        action = Action(np.column_stack([rows, rows]), self.spec.action.labels, delay * 1e3, step, {})
        if self.clock() > due:
            self.late.add(step)
        return action

    def stop(self) -> None:
        """End the delay."""
        if not self.stubborn:
            self.ended.set()

    def resume(self) -> None:
        """Allow delays again."""
        self.ended.clear()


def run(ticks: int, *, real: bool, stubborn: bool = False, seed: int = 0) -> dict[str, Any]:
    """Return how many steps were answered, how late at worst, and how many late actions were used."""
    clock: Any = time.monotonic if real else FakeClock()
    policy = DelayedPolicy(clock, seed, stubborn)
    stack = build_stack(
        policy, deadline_ms=DEADLINE_MS, fallback=Fallback(start=[0, 0], misses=9, recover=1), clock=clock
    )
    if real:
        prepare_process()
    else:
        stack.deadlines[0]._worker = FakeWorker(clock, stops=not stubborn)
    answers, waited, sources, late = np.empty(ticks), np.empty(ticks), Counter[str](), 0
    begin = clock() + 0.1
    for step in range(ticks):
        scheduled = begin + step / HZ
        if not real:
            clock.now = scheduled
        elif (wait := scheduled - clock()) > 0:
            time.sleep(wait)
        waited[step] = (clock() - scheduled) * 1e3
        action = stack.act({"t": step, "due": scheduled + DEADLINE_MS / 1e3}, scheduled=scheduled)
        answers[step] = (clock() - scheduled) * 1e3
        sources[stack.origin.source] += 1
        late += stack.origin.source in (POLICY, CHUNK) and int(action[0]) // 10 in policy.late
    stack.close()
    beyond = answers - np.maximum(DEADLINE_MS, waited)
    return {
        "ticks": ticks, "answered": int(sum(sources.values())), "late actions used": late, "inferences": policy.began,
        "of which late": len(policy.late), "answers from": dict(sources),
        "answer ms": _percentiles(answers), "waited ms": _percentiles(waited), "beyond ms": _percentiles(beyond),
        "answers more than 1 ms beyond": int((beyond > 1).sum()),
        "threads": threading.active_count(),
    }  # fmt: skip


def _percentiles(values: np.ndarray) -> str:
    return ", ".join(f"p{share:g} {np.percentile(values, share):.3f}" for share in (50, 99, 99.9, 100))


def main() -> None:
    """Print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=100_000)
    parser.add_argument("--real", action="store_true", help="at 100 Hz, by the clock of this machine")
    parser.add_argument("--stubborn", action="store_true", help="a policy that cannot be stopped")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found = run(options.ticks, real=options.real, stubborn=options.stubborn, seed=options.seed)
    for name, value in found.items():
        print(f"{name}: {value}")
    sys.exit(found["late actions used"] > 0 or found["answered"] < options.ticks)


if __name__ == "__main__":
    main()
