"""Which joint states an arm's controller believes: none that is farther from the last than the arm can have moved."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
LEAST_COUNT = 3
"""Joint states that have to agree before the first is believed: drivers that start report zeros for a moment."""
FASTER, ROOM = 2.0, 0.05
"""An arm that something moves is at most so many times as fast as by itself, and its readings err by so many rad."""


class Track(NamedTuple):
    """What was believed.

    Args:
        values: Positions of the joints, in the order of the robot; empty before the first.
        came_s: When the newest joint state came, believed or not, in seconds.
        sequence: Its number.
        agreed: How many of the first ones have agreed.
    """

    values: tuple[float, ...] = ()
    came_s: float = 0.0
    sequence: int = -1
    agreed: int = 0

    @property
    def has_begun(self) -> bool:
        """Whether enough joint states have agreed."""
        return self.agreed >= LEAST_COUNT


def believe(track: Track, values: Array, came_s: float, sequence: int, fastest: Array) -> tuple[Track, int]:
    """Return the track after a joint state, and which joint jumped; -1 for none.

    Args:
        values: Positions (A,).
        came_s: When they came, in seconds.
        sequence: Number of the message; one that was seen before changes nothing.
        fastest: Largest speeds (A,) in units/s; infinite where none is known.
    """
    if sequence == track.sequence:
        away = np.abs(values - np.array(track.values)) if track.values else np.zeros(len(values))
        return track, int(away.argmax()) if away.any() else -1
    found = tuple(values.tolist())
    if not track.values:
        return Track(found, came_s, sequence, 1), -1
    away = np.abs(values - np.array(track.values))
    jumps = np.flatnonzero(away > FASTER * fastest * max(came_s - track.came_s, 0.0) + ROOM)
    if not len(jumps):
        return Track(found, came_s, sequence, track.agreed + 1), -1
    if not track.has_begun:
        return Track(found, came_s, sequence, 1), -1
    return track._replace(came_s=came_s, sequence=sequence), int(jumps[0])
