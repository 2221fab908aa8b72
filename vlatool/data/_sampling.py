"""Samples of a dataset: spread over tasks, episodes and phases; and a recording as an ``.npz`` file."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data._recording import PADDING, Recording, Values
from vlatool.files.rows import blocks

Array = NDArray[Any]
GOLDEN = (math.sqrt(5) - 1) / 2
"""Multiples of it, modulo 1, are spread evenly however many there are."""
CARRIED_SAMPLES = 512
CARRIED_BYTES = 1 << 29
"""Samples of a dataset that a bundle carries, and their size, of which large pictures are fewer."""
MIN_CARRIED = 32
ARCHIVE_COMMENT = b"written by vlatool"
"""Comment of the archive, by which a file may be replaced."""


def sampled_rows(episodes: Array, count: int, tasks: Array | None = None) -> NDArray[np.intp]:
    """Return ``count`` rows of a dataset (or all), ascending: each task as often as every other, then each episode.

    Within an episode, rows are equally far apart; in which phase the first one is differs from episode to episode.

    Args:
        episodes: (N,) episode of each row; its rows follow each other.
        tasks: (N,) task of each row.

    Example:
        >>> sampled_rows(np.repeat([0, 1], [2, 8]), 4).tolist()
        [0, 1, 4, 8]
    """
    if count >= len(episodes):
        return np.arange(len(episodes))
    firsts = np.concatenate([[0], np.flatnonzero(np.diff(episodes)) + 1])
    lengths = np.diff(np.append(firsts, len(episodes)))
    task_of = np.zeros(len(firsts), np.int64) if tasks is None else tasks[firsts]
    names = np.unique(task_of)
    available = [int(lengths[task_of == name].sum()) for name in names]
    chosen: list[NDArray[np.intp]] = []
    for name, size in zip(names, _shares(available, count), strict=True):
        inside = np.flatnonzero(task_of == name)
        sizes = _shares(lengths[inside].tolist(), size)
        for rank, (episode, rows) in enumerate(zip(inside, sizes, strict=True)):
            length = int(lengths[episode])
            start = int(rank * GOLDEN % 1 * length)
            chosen.append(firsts[episode] + (np.arange(rows) * length + start) // max(1, rows))
    return np.sort(np.concatenate(chosen))


def _shares(available: list[int], count: int) -> list[int]:
    """Divide a number as equally as what is available allows; what remains goes to places that are spread evenly.

    Example:
        >>> _shares([2, 8, 8], 12)
        [2, 5, 5]
    """
    shares = [0] * len(available)
    while count > 0 and (places := [at for at, size in enumerate(available) if shares[at] < size]):
        if len(places) > count:
            places = [places[int((number + 0.5) * len(places) / count)] for number in range(count)]
        each = max(1, count // len(places))
        for at in places:
            added = min(each, available[at] - shares[at], count)
            shares[at] += added
            count -= added
    return shares


def sampled_episodes(episodes: Array, count: int) -> NDArray[np.intp]:
    """Return the rows of whole episodes, spread over the dataset, until there are ``count``; at least two episodes."""
    names = np.unique(episodes)
    order = np.argsort(np.arange(len(names)) * GOLDEN % 1, kind="stable")
    sizes = np.array([np.count_nonzero(episodes == names[at]) for at in order[:count]])
    number = max(2, int(np.searchsorted(np.cumsum(sizes), count, side="right")))
    return np.flatnonzero(np.isin(episodes, names[order[:number]]))


def rows_to_carry(recording: Recording, keeps: bool) -> NDArray[np.intp]:
    """Return the rows of a dataset that a bundle carries.

    Args:
        keeps: whether the policy keeps values, so that an observation is of use only after those before it.
    """
    row = sum(math.prod(values.shape[1:]) * values.dtype.itemsize for values in recording.inputs.values())
    count = max(MIN_CARRIED, min(CARRIED_SAMPLES, CARRIED_BYTES // max(1, row)))
    episodes = np.zeros(len(recording), np.int64) if recording.episodes is None else recording.episodes
    if keeps and recording.episodes is not None and count < len(recording):
        return sampled_episodes(episodes, count)
    return sampled_rows(episodes, count, task_numbers(recording))


def task_numbers(recording: Recording) -> Array | None:
    """Return a number for each text that the first sample of an episode has; None where there is no text."""
    texts = [values for values in recording.inputs.values() if values.dtype.kind == "U"]
    if not texts or recording.episodes is None:
        return None
    firsts = np.concatenate([[0], np.flatnonzero(np.diff(recording.episodes)) + 1])
    numbers = np.unique(texts[0][firsts.tolist()], return_inverse=True)[1]
    return np.repeat(numbers, np.diff(np.append(firsts, len(recording))))


def save_recording(recording: Recording, path: Path) -> None:
    """Write a recording as ``.npz``, a few megabytes at a time."""
    arrays: dict[str, Values] = dict(recording.inputs)
    if recording.actions is not None:
        arrays["action"] = recording.actions
    if recording.padded is not None and recording.padded.any():
        arrays[PADDING] = recording.padded
    if recording.episodes is not None:
        arrays["episode"] = recording.episodes
    save_arrays(arrays, path)


def save_arrays(arrays: Mapping[str, Values], path: Path) -> None:
    """Write arrays as ``.npz``, a few megabytes at a time.

    Raises:
        DataError: when a row cannot be read.
        OSError: when the file cannot be written.
    """
    with zipfile.ZipFile(path, "w") as archive:
        archive.comment = ARCHIVE_COMMENT
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                header = {"descr": values.dtype.str, "fortran_order": False, "shape": tuple(map(int, values.shape))}
                np.lib.format.write_array_header_1_0(stream, header)
                for _, block in blocks(values):
                    stream.write(np.ascontiguousarray(block).tobytes())


def is_sample(path: Path) -> bool:
    """Return whether a file was written by ``save_arrays``."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.comment == ARCHIVE_COMMENT
    except (OSError, zipfile.BadZipFile):
        return False
