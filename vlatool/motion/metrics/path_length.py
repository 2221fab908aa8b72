"""How far the end effector or the base went."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, lengths


class PathLength(Metric):
    """Length of the path: sum over t of |p(t+1) - p(t)|."""

    title = "path"
    unit = "length"

    def of(self, track: Track) -> float | None:
        """Return the length; None without positions."""
        return None if track.position is None or len(track.position) < 2 else float(lengths(track.position).sum())
