"""Chunks of a policy over recorded single actions: the actions that follow each step in its episode."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows
from vlatool.data._recording import Recording

Array = NDArray[Any]


def episode_ends(episodes: Array) -> NDArray[np.intp]:
    """Return for each row the index behind the last row of its episode.

    Example:
        >>> episode_ends(np.array([4, 4, 7])).tolist()
        [2, 2, 3]
    """
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(episodes)) + 1, [len(episodes)]])
    return np.repeat(bounds[1:], np.diff(bounds))


def with_windows(recording: Recording) -> Recording:
    """Return a recording of single actions, one for each observation, with those that follow in its episode.

    A window that would go beyond the end of its episode repeats the last action there, and is marked in ``padded``:
    nothing is judged by an action that nobody recorded. Where no episode is as long as the policy's chunk, windows are
    as long as the longest episode.

    Args:
        recording: With actions (N, 1, A), or (N, 1) indices; episodes follow each other.
    """
    single = recording.actions
    if single is None or single.shape[1] != 1:
        return recording
    rows = np.arange(len(recording))
    ends = episode_ends(np.zeros(len(recording)) if recording.episodes is None else recording.episodes)
    steps = min(recording.chunk, int((ends - rows).max()))
    offsets = np.arange(steps)

    def fetch(indices: NDArray[np.intp]) -> Array:
        windows: Array = single[np.minimum(indices[:, None] + offsets, ends[indices, None] - 1), 0]
        return windows

    shape = (len(recording), steps, *single.shape[2:])
    actions = LazyRows(fetch, shape, single.dtype, f"the expert's action in {recording.path}")
    return replace(recording, actions=actions, padded=rows + steps > ends)
