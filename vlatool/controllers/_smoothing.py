"""What the followers remember: the last velocity, which fades step by step, and when the target was seen."""

from __future__ import annotations

from math import copysign
from typing import NamedTuple

from vlatool.controllers._target import Target


class Motion(NamedTuple):
    """State of a follower.

    Args:
        linear: Last velocity forward, in m/s.
        angular: Last rotation speed to the left, in rad/s.
        seen_s: When the target was seen last, in seconds of ``Snapshot.time_s``; None before.
        target: Where the region of interest comes from.
    """

    linear: float = 0.0
    angular: float = 0.0
    seen_s: float | None = None
    target: Target = Target()

    def fade(self, factor: float, time_s: float, lost_s: float) -> Motion:
        """Return the motion without a target: slower by a factor, and none where it was lost too long ago."""
        if self.seen_s is None or time_s - self.seen_s >= lost_s:
            return self._replace(linear=0.0, angular=0.0)
        return self._replace(linear=self.linear * factor, angular=self.angular * factor)


def within(speed: float, slowest: float, fastest: float) -> float:
    """Return a speed with its magnitude raised to the slowest and cut to the fastest."""
    return copysign(max(slowest, min(fastest, abs(speed))), speed)
