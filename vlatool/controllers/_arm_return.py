"""The way of an arm to its start pose: straight in joint space, with least jerk, within the limits."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from vlatool.runtime.action_elements import minimum_jerk
from vlatool.runtime.envelope import RobotLimits

PEAK_VELOCITY, PEAK_ACCELERATION, PEAK_JERK = 1.875, 10.0 / sqrt(3.0), 60.0
"""Greatest derivatives of the minimum-jerk polynomial from 0 to 1 in a time of 1 (Flash and Hogan 1985)."""
SHARE = 0.8
"""Part of the limits that the way uses: what is sampled and sent late stays within them, too."""


class Return(NamedTuple):
    """A way from rest to rest.

    Args:
        begin, end: Positions of all joints.
        began_s: When it begins, by the clock of the snapshots.
        duration_s: How long it takes.
    """

    begin: tuple[float, ...]
    end: tuple[float, ...]
    began_s: float
    duration_s: float

    def at(self, time_s: float) -> list[float]:
        """Return the positions at a time."""
        passed = time_s - self.began_s
        share = 1.0 if passed >= self.duration_s else minimum_jerk(max(0.0, passed / self.duration_s))
        if share == 1.0:
            return list(self.end)
        return [a + share * (b - a) for a, b in zip(self.begin, self.end, strict=True)]

    def is_over(self, time_s: float) -> bool:
        """Return whether the robot is commanded to the end."""
        return time_s - self.began_s >= self.duration_s


def plan_return(begin: tuple[float, ...], end: tuple[float, ...], limits: RobotLimits, now_s: float) -> Return:
    """Return the way from a pose at rest to another, as fast as ``SHARE`` of the limits allows.

    A joint that is commanded by position alone, such as a gripper, follows along.
    """
    duration = 0.0
    for joint, a, b in zip(limits.joints, begin, end, strict=True):
        if joint.command == "range":
            continue
        way, velocity = abs(b - a) / SHARE, min(-joint.velocity[0], joint.velocity[1])
        duration = max(
            duration, PEAK_VELOCITY * way / velocity, sqrt(PEAK_ACCELERATION * way / joint.acceleration),
            (PEAK_JERK * way / joint.jerk) ** (1.0 / 3.0),
        )  # fmt: skip
    return Return(begin, end, now_s, duration)
