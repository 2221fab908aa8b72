"""How often the robot ran into something."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track
from vlatool.report import COUNT


class Collisions(Metric):
    """Steps that the environment tells as collisions."""

    title = "collisions"
    unit = COUNT

    def of(self, track: Track) -> float | None:
        """Return how many; None where the environment does not tell."""
        return None if track.collision is None else float(track.collision.sum())
