"""How much farther than necessary the base went."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, lengths


class Detour(Metric):
    """Length of the path, as a multiple of the shortest one to the goal."""

    title = "detour"
    unit = "x"

    def of(self, track: Track) -> float | None:
        """Return it; None without positions, or where the environment tells no shortest path, or one of 0."""
        if track.position is None or len(track.position) < 2 or not track.shortest:
            return None
        return float(lengths(track.position).sum()) / track.shortest
