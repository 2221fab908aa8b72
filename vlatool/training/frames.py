"""Training data: encoded observations and the teacher's labels, in rounds on the disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from vlatool.data import BEGINS
from vlatool.errors import DataError
from vlatool.runtime.interface import Array

BLOCK_ROWS = 256
"""Number of rows that are copied at a time."""


class Frames:
    """Rounds of rows, each round a folder with ``NAME.npy`` of (N, ...) that stays on the disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rounds: list[dict[str, Array]] = []

    def __len__(self) -> int:
        return sum(len(next(iter(arrays.values()))) for arrays in self._rounds)

    @property
    def count(self) -> int:
        """Number of rounds in use."""
        return len(self._rounds)

    def has(self, number: int) -> bool:
        """Return whether a round was written completely, also by an earlier run."""
        return self._round_folder(number).is_dir()

    def read(self, number: int) -> None:
        """Use a round that was written, after those before it."""
        files = sorted({*self._round_folder(number).glob("*.npy")} - {begins_file(self._round_folder(number))})
        self._rounds.append({unquote(file.stem): np.load(file, mmap_mode="r") for file in files})

    def draft(self, number: int) -> Path:
        """Return an empty folder in which a round is written, and which ``keep`` makes a round."""
        draft = self._folder / f"draft-{number:03d}"
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        return draft

    def keep(self, number: int) -> None:
        """Make a draft a round."""
        (self._folder / f"draft-{number:03d}").rename(self._round_folder(number))

    def row_indices(self, number: int) -> Array:
        """Return the numbers over all rounds of the rows of one."""
        sizes = [len(next(iter(arrays.values()))) for arrays in self._rounds]
        return np.arange(sizes[number]) + sum(sizes[:number])

    def draw(self, random: np.random.Generator, size: int) -> Array:
        """Draw the indices of a batch of a number of rows."""
        return random.integers(len(self), size=size)

    def row_count(self, indices: Array) -> int:
        """Return the number of rows at indices."""
        return len(indices)

    def sample(self, numbers: Sequence[int], most: int) -> Array:
        """Return the indices of a number of rows of some rounds, or of all their rows, evenly spaced."""
        rows = np.concatenate([self.row_indices(number) for number in numbers])
        return rows[evenly_spaced(len(rows), most)]

    def batch(self, indices: Array) -> Any:
        """Return the argument of a loss for indices: name -> (B, ...)."""
        return self.rows(indices)

    def sample_rows(self, most: int) -> dict[str, Array]:
        """Return a number of rows, spread over all rounds: name -> (N, ...)."""
        return self.rows(evenly_spaced(len(self), most))

    def rows(self, rows: Array) -> dict[str, Array]:
        """Return rows by their numbers over all rounds: name -> (B, ...)."""
        starts = np.cumsum([0, *(len(next(iter(arrays.values()))) for arrays in self._rounds)])
        which = np.searchsorted(starts, rows, side="right") - 1
        offsets = np.asarray(rows) - starts[which]
        return {
            name: np.stack([self._rounds[number][name][row] for number, row in zip(which, offsets, strict=True)])
            for name in self._rounds[0]
        }

    def begins(self, number: int) -> Array:
        """Return the numbers over all rounds of the rows of one with which episodes begin."""
        indices: Array = self.row_indices(number)[np.load(begins_file(self._round_folder(number)))]
        return indices

    def _round_folder(self, number: int) -> Path:
        return self._folder / f"round-{number:03d}"


def begins_file(folder: Path) -> Path:
    """Return the file that says of each row of a round whether an episode begins with it; no input's has that name."""
    return folder / f"{BEGINS}.npy"


def evenly_spaced(count: int, most: int) -> Array:
    """Return the indices of ``most`` of a number of rows, or of all, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def new_array(path: Path, dtype: Any, shape: tuple[int, ...]) -> Array:
    """Return an array in a new ``.npy`` file, whose space is allocated: on a full disk a later write would crash.

    Raises:
        OSError: when there is no room for it.
    """
    array: Array = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)
    with path.open("r+b") as stream:
        os.posix_fallocate(stream.fileno(), 0, path.stat().st_size)
    return array


def concatenate(parts: Iterable[Path], target: Path) -> int:
    """Join the ``NAME.npy`` of several folders; return the number of rows; raises DataError when there are none."""
    folders = [part for part in parts if part.is_dir() and any(part.iterdir())]
    if not folders:
        raise DataError(
            "There are no observations to train on.",
            "record some and name them in policy.yaml (calibration: FILE.npz), or name an environment there, or a "
            "function that yields batches (training: train.py:batches)",
        )
    names = sorted(file.name for file in folders[0].glob("*.npy"))
    for name in names:
        arrays = [np.load(folder / name, mmap_mode="r") for folder in folders]
        rows = sum(map(len, arrays))
        whole = new_array(target / name, arrays[0].dtype, (rows, *arrays[0].shape[1:]))
        for at, block in _blocks(arrays):
            whole[at : at + len(block)] = block
    return rows


def _blocks(arrays: Iterable[Array]) -> Iterator[tuple[int, Array]]:
    at = 0
    for array in arrays:
        for start in range(0, len(array), BLOCK_ROWS):
            block = array[start : start + BLOCK_ROWS]
            yield at, block
            at += len(block)
