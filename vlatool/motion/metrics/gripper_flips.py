"""How often the gripper opens and closes."""

from __future__ import annotations

import numpy as np

from vlatool.motion.metric import Metric
from vlatool.motion.track import Array, Track
from vlatool.report import COUNT

BAND = 0.1
"""Distance from the middle within which a gripper is neither open nor closed, so that noise does not count."""


class GripperFlips(Metric):
    """Changes between open and closed, of the opening that the environment tells, or of the action's element."""

    title = "gripper flips"
    unit = COUNT

    def of(self, track: Track) -> float | None:
        """Return how many; None without a gripper."""
        if track.gripper is not None:
            return float(flips(track.gripper, 0.5))
        if track.grip is None or track.actions.ndim != 2:
            return None
        effort = track.actions[:, track.grip]
        return float(flips(effort, 0.0 if effort.min() < 0 else 0.5))


def flips(opening: Array, middle: float) -> int:
    """Return how often a series goes from one side of the middle to the other, by more than ``BAND``."""
    sides = np.sign(opening[np.abs(opening - middle) > BAND] - middle)
    return int((sides[1:] != sides[:-1]).sum())
