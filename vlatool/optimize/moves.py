"""Whether a candidate moves as float32 does, and keeps to the limit on its worst task: in words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from vlatool.accuracy.motion_comparison import worst_task
from vlatool.measures.latency import SPEEDUP
from vlatool.measures.motion import RATIO, STEPS_RATIO, TASK_SPEEDUP
from vlatool.measures.success import SUCCESS_DROP, WORST_TASK_DROP
from vlatool.optimize.recipe import Limits
from vlatool.report import Measurement, Row

BODY_METRICS = {"task_time": "task time", "path_length": "path", "joint_path": "path of the joints", "jerk": "jerk",
           "joint_jerk": "jerk of the joints"}  # fmt: skip
"""Metrics that ``max_motion`` is about -> their names in sentences."""
ACTION_METRICS = {"task_time": "task time", "action_rate": "action rate"}
"""The same where the environment tells nothing of the robot's body."""
LEAST_LOSS = 1e-4


class Miss(NamedTuple):
    """A limit that is not kept: by how much, as a multiple of it, and in words."""

    by: float
    words: str


@dataclass(frozen=True)
class Held:
    """What limits say of a row."""

    missed: tuple[Miss, ...] = ()
    warnings: tuple[str, ...] = ()

    @classmethod
    def missing(cls, by: float, words: str) -> Held:
        """Return what one limit says that is not kept."""
        return cls((Miss(by, words),))

    @classmethod
    def all(cls, found: Iterable[Held]) -> Held:
        """Return what several limits say."""
        found = list(found)
        return cls(tuple(miss for each in found for miss in each.missed),
                   tuple(text for each in found for text in each.warnings))  # fmt: skip

    @property
    def miss(self) -> float:
        """By how much all limits together are missed; 0 when none is."""
        return sum(miss.by for miss in self.missed)


def limited_metrics(row: Row) -> dict[str, str]:
    """Return the metrics that a limit on motion is about, for what is known of a row -> their names in sentences."""
    of_body = any(row.get(RATIO.quantity(name)) for name in BODY_METRICS if name != "task_time")
    return BODY_METRICS if of_body else ACTION_METRICS


def judge_moves(row: Row, limits: Limits) -> Held:
    """Hold a candidate's motion, its steps and its worst task against the limits."""
    return Held.all((*_motion(row, limits), *_steps(row, limits), *_worst(row, limits)))


def _motion(row: Row, limits: Limits) -> Iterator[Held]:
    if limits.max_motion is None or row.get(SUCCESS_DROP) is None:
        return
    known = {
        words: ratio
        for name, words in limited_metrics(row).items()
        if (ratio := row.get(RATIO.quantity(name))) is not None
    }
    if not known:
        yield Held.missing(1.0, "its motion is unknown: it shares no success with float32")
    for words, ratio in known.items():
        growth = ratio.value - 1
        if growth > limits.max_motion:
            reason = f"{words} {_grows(ratio)}, allowed {100 * limits.max_motion:.3g} % (--max-motion)"
            yield Held.missing(growth / max(limits.max_motion, 1e-3) - 1, reason)
        elif ratio.high is None or ratio.high - 1 > limits.max_motion:
            yield Held(warnings=(f"{row.name}: {words} {_grows(ratio)}; {ratio.samples} pairs of episodes cannot "
                                  f"exclude more than {100 * limits.max_motion:.3g} %",))  # fmt: skip


def _steps(row: Row, limits: Limits) -> Iterator[Held]:
    """Yield a reason against a candidate that needs so many more steps that little of its speed-up is left."""
    steps = row.get(STEPS_RATIO)
    if steps is None or steps.low is None or steps.low <= 1 or 1 / steps.value >= limits.min_task_share:
        return
    span = f" ({steps.low:.2f} to {steps.high or steps.value:.2f})"
    reason = f"it needs {steps.value:.2f}x the steps of float32{span}, so that {100 / steps.value:.0f} % of its "
    reason += f"speed-up is left for the whole task, required {100 * limits.min_task_share:.3g} % (min_task_share)"
    yield Held.missing(steps.value * limits.min_task_share - 1, reason)


def _worst(row: Row, limits: Limits) -> Iterator[Held]:
    worst = row.get(WORST_TASK_DROP) or row.get(SUCCESS_DROP)  # of one task there is none worse
    if limits.worst_task is None or worst is None:
        return
    where = f"in {worst_task(worst)}" if worst.name == WORST_TASK_DROP.name else "in its only task"
    span = "" if worst.low is None else f" ({100 * worst.low:.3g} to {100 * (worst.high or worst.value):.3g})"
    drop = f"success {where} drops by {100 * worst.value:.3g} points{span}"
    allowed = f"allowed {100 * limits.worst_task:.3g} (--worst-task)"
    if worst.value > limits.worst_task + LEAST_LOSS:
        yield Held.missing(worst.value / max(limits.worst_task, 1e-3) - 1, f"{drop}, {allowed}")
    elif (worst.high or 0.0) > limits.worst_task:
        yield Held(warnings=(f"{row.name}: {drop}, {allowed}: {worst.samples} episodes cannot decide it",))


def _grows(ratio: Measurement) -> str:
    span = "" if ratio.low is None else f" ({ratio.low:.3g}x to {ratio.high or ratio.value:.3g}x)"
    return f"is {ratio.value:.3g}x that of float32{span}"


def slower_task(row: Row) -> str:
    """Return what is said of a candidate whose task gains less than its inferences; empty where it gains as much."""
    task, speed, steps = row.get(TASK_SPEEDUP), row.get(SPEEDUP), row.get(STEPS_RATIO)
    if task is None or speed is None or steps is None:
        return ""
    words = f"{row.name} does its task {task.value:.2f}x as fast as float32, where inferences set the pace: its "
    return f"{words}inferences are {speed.value:.2f}x as fast, and it needs {steps.value:.2f}x the steps."
