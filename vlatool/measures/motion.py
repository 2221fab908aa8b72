"""How a variant moves, as a multiple of the baseline in the episodes in which both succeed."""

from __future__ import annotations

from vlatool.measures import MOTION, Family, Quantity
from vlatool.measures.latency import SPEEDUP
from vlatool.report import Measurement, Row

BOOTSTRAP = "bootstrap of paired episodes"


def task_speedup(row: Row) -> Measurement | None:
    """Return how many times as fast a variant does its task: its speed-up by the ratio of its steps.

    A policy that answers in half of the time and needs twice as many steps is done no sooner, where the control loop
    waits for its answers.
    """
    speed, steps = row.get(SPEEDUP), row.get(STEPS_RATIO)
    if speed is None or steps is None or not steps.value or None in (speed.low, speed.high, steps.low, steps.high):
        return None
    low, high = (speed.low or 0.0) / max(steps.high or 0.0, 1e-9), (speed.high or 0.0) / max(steps.low or 0.0, 1e-9)
    note = "speed-up of an inference / ratio of steps, failures at full length"
    return TASK_SPEEDUP.measurement(speed.value / steps.value, samples=steps.samples, low=low, high=high, note=note)


TASK_SPEEDUP = Quantity(
    "task_speedup", "x", better="more", section=MOTION, order=10, interval="of speed-up and steps", of=task_speedup
)
STEPS_RATIO = Quantity("steps_ratio", "x", section=MOTION, order=20, interval=BOOTSTRAP)
RATIO = Family(Quantity("{metric}_ratio", "x", "{metric} ratio", section=MOTION, interval=BOOTSTRAP))
ADDED_MEAN = Family(Quantity("{metric}_added", "", "{metric} added", section=MOTION))
"""The mean of a metric that is 0 in every episode of the baseline, so that there is no ratio."""


def mean_of(metric: str, unit: str) -> Quantity:
    """Return the mean of a metric of motion over the episodes that succeed, which has the metric's name."""
    return Quantity(metric, unit)
