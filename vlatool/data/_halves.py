"""One recording for two purposes: what calibrates is not what evaluates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vlatool.data._recording import Recording

MIN_HALF = 8
"""Observations of a half; a recording of fewer than twice as many is not split."""
BLOCKS = 8
"""Stretches that take turns where episodes are not recorded: all phases in both halves, neighbours mostly in one."""


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """Return what to calibrate with and what to hold out: whole episodes where they are recorded, else stretches.

    A recording of fewer than ``2 * MIN_HALF`` observations is both halves. The same recording is always split the same.
    """
    if len(recording) < 2 * MIN_HALF:
        return recording, recording
    held_out = _whole_episodes(recording.episodes)
    if held_out is None:
        held_out = np.arange(len(recording)) * BLOCKS // len(recording) % 2 == 1
    return recording.subset(~held_out), recording.subset(held_out)


def _whole_episodes(episodes: NDArray[np.int64] | None) -> NDArray[np.bool_] | None:
    """Say of each observation whether it is held out, None when whole episodes make no two halves.

    Each episode, in the order of the recording, goes where there are fewer observations so far.
    """
    if episodes is None:
        return None
    names, firsts, counts = np.unique(episodes, return_index=True, return_counts=True)
    sides: tuple[list[int], list[int]] = ([], [])
    sizes = [0, 0]
    for index in np.argsort(firsts):
        side = 0 if sizes[0] <= sizes[1] else 1
        sides[side].append(int(names[index]))
        sizes[side] += int(counts[index])
    return np.isin(episodes, sides[1]) if min(sizes) >= MIN_HALF else None
