"""How much commands change from step to step."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, lengths


class ActionRate(Metric):
    """Mean over t of |a(t+1) - a(t)|, of the elements that share the action's most frequent unit."""

    title = "action rate"
    unit = "action"

    def of(self, track: Track) -> float | None:
        """Return it; None for discrete actions, and for fewer than two of them."""
        commands = track.commands
        return None if commands is None or len(commands) < 2 else float(lengths(commands).mean())
