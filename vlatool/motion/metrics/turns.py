"""How often the base turned on the spot."""

from __future__ import annotations

import numpy as np

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, lengths
from vlatool.report import COUNT

MIN_TURN = 1e-6
"""Radians from which on a base has turned."""


class Turns(Metric):
    """Steps in which the heading changes, and the position does not."""

    title = "turns on the spot"
    unit = COUNT

    def of(self, track: Track) -> float | None:
        """Return how many; None without positions and headings."""
        if track.position is None or track.heading is None or len(track.position) < 2:
            return None
        turned = np.abs(np.angle(np.exp(1j * np.diff(track.heading)))) > MIN_TURN
        return float((turned & (lengths(track.position) == 0)).sum())
