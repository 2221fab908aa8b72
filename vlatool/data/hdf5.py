"""HDF5 files of ALOHA (one episode a file, in a directory) and of robomimic (all episodes in one file)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.data._lazy_rows import LazyRows
from vlatool.data._pictures import decode_picture, library_errors, stack_pictures
from vlatool.data._recording import Recording, Values
from vlatool.data._robomimic import (
    INSTRUCTION,
    MASK,
    check_samples,
    chosen_by,
    filter_keys,
    instruction_of,
    notes_on,
    rate_of,
)
from vlatool.data._step_reader import StepReader, recording_of
from vlatool.data._steps import Steps
from vlatool.errors import DataError, require
from vlatool.files.limits import check_limit
from vlatool.registry import Claim

Array = NDArray[Any]
SUFFIXES = (".hdf5", ".h5")
MAGIC = b"\x89HDF\r\n\x1a\n"
ACTIONS = ("action", "actions")
LEFT_OUT = ("next_obs", "rewards", "dones")
"""Groups and datasets of an episode that no policy takes."""
RECORD_AGAIN = "record the episode again, or leave its file out"
DIGITS = re.compile(r"(\d+)")


class Hdf5(StepReader):
    """Reads ``action`` and ``observations/...`` of ALOHA, ``data/demo_N/...`` of robomimic."""

    suffix: ClassVar[str] = ".hdf5"
    needs: ClassVar[str] = "a .hdf5 file of robomimic or ALOHA, or a directory of them"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a HDF5 file by its first bytes, or a directory that holds some by their names."""
        if path.is_dir():
            return Claim.CERTAIN if any(_files(path)) else Claim.NONE
        if path.name.endswith(SUFFIXES):
            return Claim.CERTAIN
        with path.open("rb") as stream:
            return Claim.CERTAIN if stream.read(len(MAGIC)) == MAGIC else Claim.NONE

    def steps(self, path: Path) -> Steps:
        """Return what a file, or all files of a directory, hold.

        Raises:
            DataError: when one is corrupt, refers to other files, or holds other names than the first.
            MissingExtra: when h5py is not installed.
        """
        return _steps(path, "")

    def open(self, path: Path, spec: PolicySpec, names: Mapping[str, str]) -> Recording:
        """Open a recording, of robomimic's filter key alone that ``names`` has for ``mask``; see ``recording_of``.

        Raises:
            DataError: when it is corrupt, has no such filter key, or does not fit the spec.
            MissingExtra: when h5py is not installed.
        """
        key = "" if any(tensor.name == MASK for tensor in spec.inputs) else names.get(MASK, "")
        others = {name: each for name, each in names.items() if not (key and name == MASK)}
        return recording_of(_steps(path, key), spec, others)


def _steps(path: Path, key: str) -> Steps:
    """Return what files hold, of the episodes of a filter key; of all when it is empty."""
    files = list(_files(path)) if path.is_dir() else [path]
    found = [_episodes(file, key) for file in files]
    episodes = [episode for content in found for episode in content.episodes]
    if not episodes:
        raise DataError(f"{path} holds no episodes.", RECORD_AGAIN)
    lengths = [episode.length for episode in episodes]
    columns = {name: _column(path, name, episodes, lengths) for name in _names(path, episodes)}
    action = next((name for name in ACTIONS if name in columns), "")
    texts = [episode.instruction for episode in episodes]
    if any(texts) and INSTRUCTION not in columns:
        columns[INSTRUCTION] = np.repeat(np.array(texts), lengths)
    rates = {content.rate for content in found}
    notes = dict.fromkeys(note for content in found for note in content.notes)
    return Steps(path, columns, np.repeat(np.arange(len(episodes)), lengths), action=action,
                 hz=rates.pop() if len(rates) == 1 else 0.0, notes=tuple(notes))  # fmt: skip


@dataclass(frozen=True)
class _Episode:
    """One episode.

    Args:
        group: its group in the file; empty for the whole file.
        columns: name -> shape and dtype of its dataset.
        compressed: whether pictures are JPEG, padded to one length.
        instruction: text of an attribute; empty without.
    """

    file: Path
    group: str
    length: int
    columns: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]
    compressed: bool
    instruction: str = ""

    @property
    def where(self) -> str:
        """The episode in messages."""
        return f"{self.file}{f' ({self.group})' if self.group else ''}"


def _natural(text: str) -> list[Any]:
    """Sort ``demo_10`` behind ``demo_9``."""
    return [int(part) if part.isdecimal() else part for part in DIGITS.split(text)]


def _files(folder: Path) -> Iterator[Path]:
    yield from sorted(
        (file for suffix in SUFFIXES for file in folder.glob(f"*{suffix}")), key=lambda f: _natural(f.name)
    )


def _open(file: Path) -> Any:
    library = require("h5py", "data")
    with library_errors(str(file), RECORD_AGAIN):
        return library.File(str(file), "r", locking=False)


@dataclass(frozen=True)
class _Content:
    """Episodes of a file, the rate in Hz that it names, and sentences on what is unusual."""

    episodes: list[_Episode]
    rate: float = 0.0
    notes: tuple[str, ...] = ()


def _episodes(file: Path, key: str) -> _Content:
    with _open(file) as opened, library_errors(str(file), RECORD_AGAIN):
        if "data" not in opened or not hasattr(opened["data"], "keys"):
            if key:
                raise DataError(
                    f"{file} is not a file of robomimic: only those have filter keys.", f"leave --map mask={key} out"
                )
            return _Content([_episode(file, opened, "")])
        names = sorted(opened["data"], key=_natural)
        chosen = chosen_by(filter_keys(opened), key, names, str(file))
        episodes = [_episode(file, opened, f"data/{name}") for name in chosen]
        return _Content(episodes, rate_of(opened), notes_on(opened, key, sum(each.length for each in episodes)))


def _episode(file: Path, opened: Any, group: str) -> _Episode:
    columns = dict(_datasets(file, opened[group] if group else opened, ""))
    lengths = {name: shape[0] for name, (shape, _) in columns.items()}
    where = f"{file}{f' ({group})' if group else ''}"
    action = next((name for name in ACTIONS if name in columns), None)
    if action is None:
        raise DataError(
            f"{where} has no {' or '.join(ACTIONS)}; it has {', '.join(sorted(columns)) or 'no datasets'}.",
            "wanted: /action and /observations/... (ALOHA), or data/demo_N/actions and obs/... (robomimic)",
        )
    length = lengths[action]
    columns = {name: value for name, value in columns.items() if name in (action,) or "/" in name or
               lengths[name] == length}  # fmt: skip
    columns.pop("compress_len", None)
    odd = {name: lengths[name] for name in columns if lengths[name] != length}
    if odd:
        raise DataError(f"{where} has {length} steps of '{action}', and of others {odd}.", RECORD_AGAIN)
    compressed = bool(opened.attrs.get("compress", False))
    if not group:
        return _Episode(file, group, length, columns, compressed)
    check_samples(opened[group], length, where)
    return _Episode(file, group, length, columns, compressed, instruction_of(opened, opened[group]))


def _datasets(file: Path, group: Any, prefix: str) -> Iterator[tuple[str, tuple[tuple[int, ...], np.dtype[Any]]]]:
    """Yield name, shape and dtype of each dataset below a group that has a row for each step."""
    library = require("h5py", "data")
    for key in group:
        name = f"{prefix}{key}"
        if key in LEFT_OUT:
            continue
        if isinstance(group.get(key, getlink=True), library.ExternalLink):
            raise DataError(f"'{name}' in {file} is a link to another file.", "copy what it stands for into the file")
        value = group[key]
        if isinstance(value, library.Group):
            if prefix.count("/") < 8:
                yield from _datasets(file, value, f"{name}/")
        elif value.shape and (prefix or value.shape[0]):  # robomimic's states are empty where nothing is simulated
            _check(file, name, value)
            yield name, (tuple(value.shape), value.dtype)


def _check(file: Path, name: str, dataset: Any) -> None:
    """Refuse what is in other files, what was never written, and what is larger than a picture may be."""
    if dataset.is_virtual or dataset.external:
        raise DataError(f"'{name}' in {file} is in another file.", "copy it into the file")
    check_limit("recorded_steps", dataset.shape[0], f"'{name}' in {file}", DataError)
    row = int(np.prod(dataset.shape[1:], dtype=object)) * dataset.dtype.itemsize
    check_limit("picture_bytes", row, f"a row of '{name}' in {file}", DataError)
    if not dataset.id.get_storage_size():
        raise DataError(f"'{name}' in {file} was never written.", RECORD_AGAIN)
    chunks = dataset.chunks and np.prod(
        [-(-size // part) for size, part in zip(dataset.shape, dataset.chunks, strict=True)]
    )
    if chunks and (written := dataset.id.get_num_chunks()) < chunks:
        raise DataError(
            f"'{name}' in {file} has {written} of {int(chunks)} chunks; the others were never written.",
            RECORD_AGAIN,
        )


def _names(path: Path, episodes: list[_Episode]) -> list[str]:
    first = episodes[0]
    for episode in episodes:
        if {*episode.columns} != {*first.columns}:
            name = min({*episode.columns} ^ {*first.columns})
            one, other = (first, episode) if name in first.columns else (episode, first)
            raise DataError(f"'{name}' is in {one.where}, and not in {other.where}.", "record every episode alike")
    return [*first.columns]


def _column(path: Path, name: str, episodes: list[_Episode], lengths: list[int]) -> Values:
    """Return a column of all episodes: pictures read when they are asked for, all else in memory."""
    shape, dtype = episodes[0].columns[name]
    pictures = "images/" in name and episodes[0].compressed
    where = f"'{name}' in {path}"
    for episode in episodes:
        other, kind = episode.columns[name]
        if (other[1:], kind) != (shape[1:], dtype) and not pictures:
            raise DataError(
                f"'{name}' is {kind} {list(other)} in {episode.where}; it is {dtype} {list(shape)} in "
                f"{episodes[0].where}.",
                "record every episode alike",
            )
    rows = _EpisodeRows(name, episodes, lengths, pictures)
    if pictures or len(shape) > 2:
        return _lazy(rows, where, sum(lengths), shape, dtype)
    values: Array = np.concatenate([rows.all_of(episode) for episode in episodes])
    return values


def _lazy(rows: _EpisodeRows, where: str, count: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> LazyRows:
    if not rows.pictures:
        return LazyRows(rows.fetch, (count, *shape[1:]), dtype, where)
    first = rows.fetch(np.zeros(1, np.intp))
    return LazyRows(rows.fetch, (count, *first.shape[1:]), first.dtype, where)


class _EpisodeRows:
    """Rows of one dataset of each episode, with one file open at a time.

    Args:
        pictures: whether they are padded JPEG, coded by OpenCV, whose first channel is the last of the standard.
    """

    def __init__(self, name: str, episodes: list[_Episode], lengths: list[int], pictures: bool) -> None:
        self._name, self._episodes, self.pictures = name, episodes, pictures
        self._ends = np.cumsum(lengths)
        self._file: Path | None = None
        self._opened: Any = None

    def all_of(self, episode: _Episode) -> Array:
        """Return all rows of an episode."""
        with library_errors(f"'{self._name}' in {episode.where}", RECORD_AGAIN):
            values: Array = self._dataset(episode)[()]
            return values if values.dtype != object else np.array([_text(value) for value in values.ravel()])

    def fetch(self, indices: NDArray[np.intp]) -> Array:
        """Return some rows."""
        rows = []
        for index in indices:
            at = int(np.searchsorted(self._ends, index, side="right"))
            inside = int(index) - (int(self._ends[at - 1]) if at else 0)
            episode = self._episodes[at]
            where = f"'{self._name}' in step {inside} of {episode.where}"
            with library_errors(where, RECORD_AGAIN):
                row = self._dataset(episode)[inside]
            rows.append(_decoded(row, where) if self.pictures else np.asarray(row))
        return stack_pictures(rows, f"'{self._name}'", indices)

    def _dataset(self, episode: _Episode) -> Any:
        if self._file != episode.file:
            if self._opened is not None:
                self._opened.close()
            self._opened, self._file = _open(episode.file), episode.file
        return self._opened[f"{episode.group}/{self._name}" if episode.group else self._name]


def _text(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _decoded(row: Any, where: str) -> Array:
    """Return a picture as it was before OpenCV compressed it: colours in the order of the array."""
    pixels = decode_picture(np.asarray(row, np.uint8).tobytes(), where)
    return pixels[:, :, ::-1] if pixels.shape[2] == 3 else pixels
