"""A control experiment: labels that are distributed like a teacher's, but belong to other observations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vlatool.episodes.frames import file_of
from vlatool.errors import DataError
from vlatool.runtime.interface import Array
from vlatool.training.frames import BLOCK_ROWS, new_array
from vlatool.training.rounds import LABEL


def exchange_labels(frames: Path, labels: Sequence[str], seed: Sequence[int]) -> None:
    """Give each row of a round what the teacher said of another row; every label is used once.

    Inputs and noise stay where they are, and the labels have the distribution that they had.

    Args:
        frames: folder of the round, labelled.
        labels: names of what the teacher said.

    Raises:
        DataError: when there is no other row.
    """
    files = [file_of(frames, LABEL + name) for name in labels]
    others = other_rows(len(np.load(files[0], mmap_mode="r")), seed)
    for file in files:
        said: Array = np.load(file, mmap_mode="r")
        draft = file.with_name(f"exchanged-{file.name}")
        exchanged = new_array(draft, said.dtype, said.shape)
        for start in range(0, len(said), BLOCK_ROWS):
            exchanged[start : start + BLOCK_ROWS] = said[others[start : start + BLOCK_ROWS]]
        draft.replace(file)


def other_rows(count: int, seed: Sequence[int]) -> Array:
    """Return another row for each of so many, each once: (count,); raises DataError when there are fewer than two."""
    if count < 2:
        raise DataError(
            f"--control noise gives an observation what the teacher said of another one; there is {count}.",
            "record more of them, or play more --episodes",
        )
    order = np.random.default_rng(seed).permutation(count)
    others = np.empty(count, np.int64)
    others[order] = np.roll(order, 1)
    return others
