"""How long an episode took."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track


class TaskTime(Metric):
    """Seconds of an episode: T / f."""

    title = "task time"
    unit = "s"

    def of(self, track: Track) -> float | None:
        """Return T / f."""
        return len(track) / track.hz
