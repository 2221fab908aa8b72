"""How far the joints went."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, lengths


class JointPath(Metric):
    """Length of the path in the space of the joints: sum over t of |q(t+1) - q(t)|."""

    title = "joint path"
    unit = "rad"

    def of(self, track: Track) -> float | None:
        """Return the length; None without joints."""
        return None if track.joints is None or len(track.joints) < 2 else float(lengths(track.joints).sum())
