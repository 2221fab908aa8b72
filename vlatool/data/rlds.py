"""RLDS datasets of TensorFlow Datasets: TFRecord files with an episode in each record, and ``features.json``."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows
from vlatool.data._pictures import decode_picture, stack_pictures
from vlatool.data._recording import Values
from vlatool.data._step_reader import StepReader
from vlatool.data._steps import Steps
from vlatool.errors import DataError, require
from vlatool.files.json import read_json
from vlatool.files.limits import check_limit, limit
from vlatool.files.printable import amount
from vlatool.registry import Claim

Array = NDArray[Any]
FEATURES = "features.json"
STEPS = "steps/"
TASK_COLUMNS = ("language_instruction", "observation/natural_language_instruction", "observation/language_instruction")
COPY_AGAIN = "copy the dataset again, or make it again with TensorFlow Datasets"
MASK_DELTA = 0xA282EAD8
"""What TFRecord adds to a rotated CRC-32C."""
FLOATS, INTEGERS, BYTES = 2, 3, 1
"""Fields of tf.train.Feature."""


class Rlds(StepReader):
    """Reads a version of a dataset: ``features.json`` and ``*.tfrecord-*``."""

    needs: ClassVar[str] = "a directory with features.json and .tfrecord files, of RLDS"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a directory with ``features.json`` and TFRecord files."""
        found = (path / FEATURES).is_file() and any(path.glob("*.tfrecord*"))
        return Claim.CERTAIN if found else Claim.NONE

    def steps(self, path: Path) -> Steps:
        """Return what a dataset holds; every record is read once, and its checksum is checked.

        Raises:
            DataError: when a file is corrupt or truncated, or a record is not what ``features.json`` says.
            MissingExtra: when google-crc32c or Pillow is not installed.
        """
        features = _features(path)
        records = [record for file in sorted(path.glob("*.tfrecord*")) for record in _records(file)]
        columns: dict[str, list[Array]] = {name: [] for name in features if not features[name].picture}
        lengths: list[int] = []
        for record in records:
            values = _parse(record.read(), record.where)
            lengths.append(_length(values, features, record.where))
            for name, parts in columns.items():
                parts.append(features[name].array(values.get(STEPS + name), lengths[-1], f"'{name}' in {record.where}"))
            check_limit("recorded_steps", sum(lengths), str(path), DataError)
        if not lengths:
            raise DataError(f"{path} holds no episodes.", COPY_AGAIN)
        result: dict[str, Values] = {name: np.concatenate(parts) for name, parts in columns.items()}
        for name in (name for name, feature in features.items() if feature.picture):
            result[name] = _picture_rows(name, records, lengths, path)
        task = next((name for name in TASK_COLUMNS if name in result), "")
        tasks = np.unique(np.concatenate(columns[task]), return_inverse=True)[1] if task else None
        action = "action" if "action" in result else ""
        return Steps(path, result, np.repeat(np.arange(len(lengths)), lengths), action=action, tasks=tasks)


@dataclass(frozen=True)
class _Feature:
    """What ``features.json`` says of one value of a step.

    Args:
        picture: whether it is a compressed picture.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    text: bool = False
    picture: bool = False

    def array(self, values: Any, length: int, where: str) -> Array:
        """Return the values of an episode, a row for each step."""
        if values is None:
            raise DataError(f"{where} is missing.", COPY_AGAIN)
        if self.text:
            if not isinstance(values, list) or len(values) != length:
                raise DataError(f"{where} is not a text for each of {amount(length, 'step')}.", COPY_AGAIN)
            return np.array([value.decode("utf-8", "replace") for value in values])
        size = length * int(np.prod(self.shape))
        if isinstance(values, list) or len(values) != size:
            raise DataError(
                f"{where} has {amount(len(values), 'value')}; {amount(length, 'step')} take {size}.", COPY_AGAIN
            )
        return np.asarray(values, self.dtype).reshape(length, *self.shape)


@dataclass(frozen=True)
class _Record:
    """A record of a TFRecord file.

    Args:
        start, size: where its data are.
    """

    file: Path
    number: int
    start: int
    size: int

    @property
    def where(self) -> str:
        """The record in messages."""
        return f"record {self.number} of {self.file}"

    def read(self) -> bytes:
        """Return its data, once the checksum was found to be right."""
        with self.file.open("rb") as stream:
            stream.seek(self.start)
            content = stream.read(self.size)
            stored = stream.read(4)
        if len(content) < self.size or len(stored) < 4:
            raise DataError(f"{self.where} is truncated.", COPY_AGAIN)
        _check(content, stored, self.where)
        return content


def _check(content: bytes, stored: bytes, where: str) -> None:
    checksum = require("google_crc32c", "data").value(content)
    masked = ((checksum >> 15 | checksum << 17) + MASK_DELTA) & 0xFFFFFFFF
    if masked != struct.unpack("<I", stored)[0]:
        raise DataError(f"{where} is corrupt: its checksum is another one.", COPY_AGAIN)


def _records(file: Path) -> Iterator[_Record]:
    """Yield where the records of a file are."""
    size, at, number = file.stat().st_size, 0, 0
    with file.open("rb") as stream:
        while at < size:
            stream.seek(at)
            head = stream.read(12)
            where = f"record {number} of {file}"
            if len(head) < 12:
                raise DataError(f"{where} is truncated.", COPY_AGAIN)
            _check(head[:8], head[8:], where)
            (length,) = struct.unpack("<Q", head[:8])
            if at + 12 + length + 4 > size:
                raise DataError(f"{where} is truncated.", COPY_AGAIN)
            check_limit("recording_bytes", length, where, DataError)
            yield _Record(file, number, at + 12, length)
            at, number = at + 12 + length + 4, number + 1


def _features(path: Path) -> dict[str, _Feature]:
    """Return the values of a step: name with ``/`` between its parts -> what it is."""
    file = path / FEATURES
    with file.open("rb") as stream:
        content = read_json(stream.read(limit("manifest_bytes")), str(file), DataError, COPY_AGAIN)
    steps = _inner(content).get("steps") if isinstance(content, dict) else None
    sequence = steps.get("sequence") if isinstance(steps, dict) else None
    step = sequence.get("feature") if isinstance(sequence, dict) else None
    found = dict(_leaves(step, "", file)) if isinstance(step, dict) else {}
    if not found:
        raise DataError(f"{file} describes no steps: wanted a dataset of RLDS.", COPY_AGAIN)
    return found


def _inner(value: Mapping[str, Any]) -> Mapping[str, Any]:
    features = value.get("featuresDict")
    inside = features.get("features") if isinstance(features, dict) else None
    return inside if isinstance(inside, dict) else {}


def _leaves(value: Mapping[str, Any], name: str, file: Path) -> Iterator[tuple[str, _Feature]]:
    if "featuresDict" in value:
        for key, inside in _inner(value).items():
            if isinstance(inside, dict):
                yield from _leaves(inside, f"{name}/{key}" if name else key, file)
    elif isinstance(value.get("image"), dict):
        yield name, _Feature((), np.dtype(np.uint8), picture=True)
    elif "text" in value:
        yield name, _Feature((), np.dtype("U1"), text=True)
    elif isinstance(tensor := value.get("tensor") or value.get("scalar") or value.get("classLabel"), dict):
        yield name, _tensor(tensor, name, file)


def _tensor(value: Mapping[str, Any], name: str, file: Path) -> _Feature:
    dtype = str(value.get("dtype", "int64"))
    shape = value.get("shape")
    axes = shape.get("dimensions", []) if isinstance(shape, dict) else []
    try:
        sizes = tuple(int(axis) for axis in axes)
        if dtype == "string":
            return _Feature((), np.dtype("U1"), text=True)
        kind = np.dtype(dtype)
    except (TypeError, ValueError):
        raise DataError(f"'{name}' in {file} has the type {dtype[:40]} {axes!r:.40}.", COPY_AGAIN) from None
    if kind.kind not in "iufb" or any(size <= 0 for size in sizes):
        raise DataError(f"'{name}' in {file} has the type {dtype[:40]} {axes!r:.40}.", COPY_AGAIN)
    return _Feature(sizes, kind)


def _fields(content: memoryview, where: str) -> Iterator[tuple[int, memoryview | int]]:
    """Yield the fields of a message of Protocol Buffers: number, and bytes or a number."""
    at = 0
    while at < len(content):
        key, at = _varint(content, at, where)
        kind = key & 7
        if kind == 0:
            value, at = _varint(content, at, where)
            yield key >> 3, value
            continue
        size, at = _varint(content, at, where) if kind == 2 else ({5: 4, 1: 8}.get(kind, -1), at)
        if size < 0 or at + size > len(content):
            raise DataError(f"{where} is not a tf.train.Example.", COPY_AGAIN)
        yield key >> 3, content[at : at + size]
        at += size


def _varint(content: memoryview, at: int, where: str) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(content):
            break
        byte = content[at]
        value, at = value | (byte & 127) << shift, at + 1
        if byte < 128:
            return value, at
    raise DataError(f"{where} is not a tf.train.Example.", COPY_AGAIN)


def _parse(content: bytes, where: str) -> dict[str, Any]:
    """Return the features of a tf.train.Example: name -> numbers as an array, or a list of bytes."""
    values: dict[str, Any] = {}
    for _, features in _messages(memoryview(content), 1, where):
        for _, entry in _messages(features, 1, where):
            parts = dict(_messages(entry, None, where))
            name = bytes(parts.get(1, b"")).decode("utf-8", "replace")
            for kind, packed in _messages(parts.get(2, memoryview(b"")), None, where):
                values[name] = _list(kind, packed, where)
    return values


def _messages(content: memoryview, number: int | None, where: str) -> Iterator[tuple[int, memoryview]]:
    for field, value in _fields(content, where):
        if isinstance(value, memoryview) and number in (None, field):
            yield field, value


def _list(kind: int, content: memoryview, where: str) -> Any:
    """Return a list of bytes, floats or integers; numbers are packed or not."""
    if kind == BYTES:
        return [bytes(value) for _, value in _messages(content, 1, where)]
    if kind == FLOATS:
        parts = b"".join(bytes(value) for _, value in _messages(content, 1, where))
        if len(parts) % 4:
            raise DataError(f"{where} is not a tf.train.Example.", COPY_AGAIN)
        return np.frombuffer(parts, "<f4")
    numbers: list[Array] = []
    for _, value in _fields(content, where):
        numbers.append(np.array([value], np.uint64) if isinstance(value, int) else _varints(value, where))
    return np.concatenate(numbers).astype(np.int64) if numbers else np.empty(0, np.int64)


def _varints(content: memoryview, where: str) -> Array:
    """Return packed integers of variable length."""
    data = np.frombuffer(content, np.uint8)
    ends = np.flatnonzero(data < 128)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if (len(data) and (not len(ends) or ends[-1] != len(data) - 1)) or (len(ends) and (ends - starts).max() > 9):
        raise DataError(f"{where} is not a tf.train.Example.", COPY_AGAIN)
    if not len(ends):
        return np.empty(0, np.uint64)
    shifts = (np.arange(len(data)) - np.repeat(starts, ends - starts + 1)) * 7
    return np.add.reduceat((data & 127).astype(np.uint64) << shifts.astype(np.uint64), starts)


def _length(values: Mapping[str, Any], features: Mapping[str, _Feature], where: str) -> int:
    """Return the number of steps of an episode, as its pictures, texts or flags say."""
    for name, feature in features.items():
        value = values.get(STEPS + name)
        if value is not None and (feature.picture or feature.text or not feature.shape):
            return len(value)
    for name, feature in features.items():
        if (value := values.get(STEPS + name)) is not None:
            return len(value) // int(np.prod(feature.shape))
    raise DataError(f"{where} has no steps; it has {', '.join(sorted(values))[:100] or 'nothing'}.", COPY_AGAIN)


def _picture_rows(name: str, records: list[_Record], lengths: list[int], path: Path) -> LazyRows:
    where = f"'{name}' in {path}"
    ends = np.cumsum(lengths)
    held: dict[int, list[bytes]] = {}

    def of_record(at: int) -> list[bytes]:
        if at not in held:
            held.clear()
            pictures = _parse(records[at].read(), records[at].where).get(STEPS + name)
            if not isinstance(pictures, list) or len(pictures) != lengths[at]:
                raise DataError(f"'{name}' in {records[at].where} is not a picture for each step.", COPY_AGAIN)
            held[at] = pictures
        return held[at]

    def fetch(rows: NDArray[np.intp]) -> Array:
        decoded = []
        for row in rows:
            at = int(np.searchsorted(ends, row, side="right"))
            inside = int(row) - int(ends[at] - lengths[at])
            decoded.append(decode_picture(of_record(at)[inside], f"'{name}' in step {inside} of {records[at].where}"))
        return stack_pictures(decoded, where, rows)

    first = fetch(np.zeros(1, np.intp))
    return LazyRows(fetch, (int(ends[-1]), *first.shape[1:]), first.dtype, where)
