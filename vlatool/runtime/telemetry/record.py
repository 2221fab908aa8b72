"""What telemetry is told of each control step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from vlatool.runtime.interface import Array, Origin

PARTS = ("encode", "infer", "decode", "handover", "envelope", "control")
"""Parts of the time in which a stack answers: the observation is encoded; the graphs run; the action is decoded; the
inference is handed to the thread of the deadline, and back; the envelope; all other layers."""


class TickRecord(NamedTuple):
    """What one control step was like.

    Args:
        step: Number of the step since the stack was built, from 0.
        started: Time at which it was to begin, in seconds of the clock.
        waited_ms: Time until the call of ``act``.
        answer_ms: Time from when it was to begin until its action was there.
        missed: Whether the policy had no action.
        rung: Index of the rung that answered, 0 for the policy.
        level: Index of the rung that the ladder stands on afterwards.
        origin: Where the action comes from.
        error: Why the policy had no action; empty where it had one.
        action: A copy of the action.
        sensed_ms: Age of the observation when the step was to begin, in milliseconds; None where nobody says.
        parts_ms: Milliseconds of each of ``PARTS``; with ``waited_ms`` they sum to ``answer_ms``.
        alarms: Names of the anomaly monitors that raise an alarm at this step.
    """

    step: int
    started: float
    waited_ms: float
    answer_ms: float
    missed: bool
    rung: int
    level: int
    origin: Origin
    error: str
    action: Array | None
    sensed_ms: float | None = None
    parts_ms: tuple[float, ...] = (0.0,) * len(PARTS)
    alarms: tuple[str, ...] = ()


class Delivery(NamedTuple):
    """When an action had reached the robot.

    Args:
        step: Number of the control step.
        transport_ms: Time from when its action was there until it was sent.
    """

    step: int
    transport_ms: float


Sink = Callable[[Any], Any]
"""Takes a ``TickRecord``, or a ``Delivery`` where the caller of the stack reports that; may have ``flush`` and
``close``, which are called after some records and after the last."""
