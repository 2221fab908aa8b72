"""How often the robot goes back where it came from."""

from __future__ import annotations

import numpy as np

from vlatool.motion.metric import Metric
from vlatool.motion.track import Track


class Reversals(Metric):
    """Share of consecutive moves that go against each other: the scalar product of their steps is negative.

    Of positions; of actions where the environment tells none, and of turns where a base only turns.
    """

    title = "reversals"
    unit = "1"

    def of(self, track: Track) -> float | None:
        """Return the share; None for discrete actions without positions, and for fewer than two moves."""
        if track.position is not None:
            moves = np.diff(track.position, axis=0)
            if track.heading is not None:  # a turn to the left and one to the right undo each other, too
                turns = np.angle(np.exp(1j * np.diff(track.heading)))
                moves = np.column_stack([moves, turns])
        elif track.commands is not None:
            moves = np.diff(track.commands, axis=0)
        else:
            return None
        return float((np.einsum("ij,ij->i", moves[1:], moves[:-1]) < 0).mean()) if len(moves) > 1 else None
