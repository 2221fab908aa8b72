"""How roughly the joints moved."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, mean_squared_jerk


class JointJerk(Metric):
    """Mean squared jerk of the joints; see ``mean_squared_jerk`` for the formula."""

    title = "joint jerk"
    unit = "rad²/s⁶"

    def of(self, track: Track) -> float | None:
        """Return it; None without joints, or with fewer than four moments of them."""
        return None if track.joints is None else mean_squared_jerk(track.joints, track.hz)
