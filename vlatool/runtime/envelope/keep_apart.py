"""A distance that parts of a robot keep, such as its two arms: along each command and along the stop behind it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.arguments import check_positive
from vlatool.runtime.envelope.axis import PositionAxis, Sample
from vlatool.runtime.envelope.stop import Phases, stop_phases, stop_positions

Array = NDArray[Any]
Pose = tuple[float, ...]
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
            most ways are allowed without computing a distance. None where nobody knows.
        step_s: Time between two positions of a stop at which it is computed, in seconds.

    Raises:
        UsageError: when a number is not above 0.
    """

    distance: Callable[[Array], Array]
    minimum_m: float
    reach_m: tuple[float, ...] | None = None
    step_s: float = 0.02
    _measured: list[tuple[Pose, float, bool]] = field(default_factory=list, init=False, repr=False, compare=False)
    """The pose whose distance was computed last, that distance, and whether the way had to be looked at.

    It changes how fast answers are, never which.
    """

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
        now = tuple(axis.value for axis in axes)
        way = self._longest_way(axes, samples)
        if self._at_least(now) - way >= self.minimum_m + ROUNDING:
            return True
        near = self._measured[-1][2] if self._measured else self.reach_m is None
        if not near:
            here = float(self.distance(np.array([now]))[0])
            self._measured[:] = [(now, here, here - way < self.minimum_m)]
            if here - way >= self.minimum_m:
                return True
        distances = self.distance(_path(now, axes, samples, interval, self.step_s))
        here = float(distances[0])
        self._measured[:] = [(now, here, here - way < self.minimum_m)]
        return here - way >= self.minimum_m or bool(np.min(distances) >= min(self.minimum_m, here) - ROUNDING)

    def _longest_way(self, axes: Sequence[PositionAxis], samples: Sequence[Sample]) -> float:
        """Return by how much the distance can change at most until the stop ends, in metres; infinity if unknown."""
        if self.reach_m is None:
            return float("inf")
        return sum(
            reach * max(sample.high - axis.value, axis.value - sample.low)
            for axis, sample, reach in zip(axes, samples, self.reach_m, strict=True)
        )

    def _at_least(self, pose: Pose) -> float:
        """Return a distance that is not above that of a pose, by the one that was computed last."""
        if self.reach_m is None or not self._measured:
            return -float("inf")
        ((before, distance, _),) = self._measured
        return distance - sum(
            reach * abs(one - other) for reach, one, other in zip(self.reach_m, pose, before, strict=True)
        )


def _path(now: Pose, axes: Sequence[PositionAxis], samples: Sequence[Sample], interval: float, step_s: float) -> Array:
    """Return positions (K, A): where the axes are, the command, and the stop behind it at ``step_s`` or wider."""
    longest, moving, stops = 0.0, [], []
    for index, (axis, sample) in enumerate(zip(axes, samples, strict=True)):
        if axis.max_jerk > 0.0:  # others have no stop
            start, phases, begun_s, left_s = _stop_of(axis, sample, interval)
            if left_s > 0.0:
                longest = max(longest, left_s)
                moving.append(index)
                stops.append((*start, *phases, begun_s))
    count = min(ceil(longest / step_s), MAX_POINTS - 2)
    positions = np.empty((count + 2, len(axes)))
    positions[0] = now
    positions[1:] = [sample.value for sample in samples]
    if count:
        times = np.arange(1, count + 1) * (longest / count)
        times[-1] = longest
        columns = np.array(stops).T
        position, velocity, acceleration = columns[:3]
        times_of_stops = columns[7] + times[:, None]
        positions[2:, moving] = stop_positions(position, velocity, acceleration, columns[3:7], times_of_stops)
    return positions


def _stop_of(
    axis: PositionAxis, sample: Sample, interval: float
) -> tuple[tuple[float, float, float], Phases, float, float]:
    """Return start and phases of the stop behind a sample, and its times before and after the sample, in seconds."""
    if sample.start is None:
        phases = axis.stop_phases()
        return axis.start, phases, axis.elapsed + interval, sum(phases[:3]) - axis.elapsed - interval
    made = stop_phases(sample.start[1], sample.start[2], axis.max_acceleration, axis.max_jerk)
    return sample.start, made, 0.0, sum(made[:3])
