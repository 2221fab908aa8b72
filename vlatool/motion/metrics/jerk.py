"""How roughly the end effector or the base moved."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, mean_squared_jerk


class Jerk(Metric):
    """Mean squared jerk of the position; see ``mean_squared_jerk`` for the formula."""

    title = "jerk"
    unit = "length²/s⁶"

    def of(self, track: Track) -> float | None:
        """Return it; None without positions, or with fewer than four of them."""
        return None if track.position is None else mean_squared_jerk(track.position, track.hz)
