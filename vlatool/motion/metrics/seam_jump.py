"""How much commands jump where a new chunk begins."""

from __future__ import annotations

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track, lengths


class SeamJump(Metric):
    """Mean |a(t+1) - a(t)| at the seams of chunks, as a multiple of the mean inside chunks."""

    title = "seam jump"
    unit = "x"

    def of(self, track: Track) -> float | None:
        """Return it; None where there are no seams or no insides, and where nothing changes inside."""
        commands = track.commands
        if commands is None or len(commands) < 2:
            return None
        change, seam = lengths(commands), track.fresh[1:]
        if not seam.any() or seam.all() or not (inside := float(change[~seam].mean())):
            return None
        return float(change[seam].mean()) / inside
