"""A distance that parts of a robot keep, such as its two arms: along each command and along the stop behind it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.arguments import check_positive
from vlatool.runtime.envelope.axis import PositionAxis, Sample
from vlatool.runtime.envelope.stop import Phases, stop_phases, stop_state

Array = NDArray[Any]
MAX_POINTS = 24
"""Points of a stop that are looked at; a longer one is looked at less closely."""
ROUNDING = 1e-9


@dataclass(frozen=True)
class KeepApart:
    """A least distance, and how it is computed.

    Args:
        distance: Returns distances in metres (K,) for positions (K, A) of the joints, in the order of the envelope.
        minimum_m: Least distance. It is one of commands: add what the robot lags behind them.
        reach_m: For each joint, how much the distance can change at most when it turns by 1 rad, in metres: with it,
            most ways are allowed without computing the distance along them. None where nobody knows.
        step_s: Time between two positions of a stop at which it is computed, in seconds.

    Raises:
        UsageError: when a number is not above 0.
    """

    distance: Callable[[Array], Array]
    minimum_m: float
    reach_m: tuple[float, ...] | None = None
    step_s: float = 0.02

    def __post_init__(self) -> None:
        check_positive("minimum_m", self.minimum_m, "a number of metres")
        check_positive("step_s", self.step_s, "a number of seconds")

    def allows(self, axes: Sequence[PositionAxis], samples: Sequence[Sample], interval: float) -> bool:
        """Return whether the way of a command and of its stop keeps the distance.

        From a place that is nearer already, a way is allowed that nowhere comes nearer still.

        Args:
            axes: As they are before the command.
            samples: The command, with the stop of each axis.
            interval: Time from the last command, in seconds.
        """
        now = np.array([axis.value for axis in axes])
        if self.reach_m is not None:
            ways = [
                reach * max(sample.high - axis.value, axis.value - sample.low)
                for axis, sample, reach in zip(axes, samples, self.reach_m, strict=True)
            ]
            if float(self.distance(now[None])[0]) - sum(ways) >= self.minimum_m:
                return True
        stops = [_stop_of(axis, sample, interval) for axis, sample in zip(axes, samples, strict=True)]
        longest = max(left for _, _, left in stops)
        count = min(ceil(longest / self.step_s), MAX_POINTS - 2)
        times = np.linspace(0.0, longest, count + 1)[1:] if count else np.empty(0)
        positions = np.empty((len(times) + 2, len(axes)))
        for index, (axis, sample, (start, phases, left)) in enumerate(zip(axes, samples, stops, strict=True)):
            positions[:2, index] = now[index], sample.value
            offset = 0.0 if sample.start is not None else axis.elapsed + interval
            for row, time in enumerate(times.tolist(), 2):
                still = phases is None or left <= 0.0
                positions[row, index] = sample.value if still else stop_state(*start, phases, offset + time)[0]
        distances = self.distance(positions)
        limit = min(self.minimum_m, float(distances[0]))
        return bool(np.min(distances) >= limit - ROUNDING)


def _stop_of(axis: PositionAxis, sample: Sample, interval: float) -> tuple[tuple[float, float, float], Any, float]:
    """Return start, phases (None for an axis that has no stop) and remaining time of the stop behind a sample."""
    if axis.max_jerk <= 0.0:
        return (sample.value, 0.0, 0.0), None, 0.0
    if sample.start is None:
        phases = axis.stop_phases()
        return axis.start, phases, max(0.0, sum(phases[:3]) - axis.elapsed - interval)
    made: Phases = stop_phases(sample.start[1], sample.start[2], axis.max_acceleration, axis.max_jerk)
    return sample.start, made, sum(made[:3])
