"""Bags of ROS 2 (sqlite3, mcap) and of ROS 1: topics become columns, at the times of one of them."""

from __future__ import annotations

import re
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows
from vlatool.data._pictures import LIBRARY_ERRORS, decode_picture, stack_pictures
from vlatool.data._recording import Values
from vlatool.data._step_reader import StepReader
from vlatool.data._steps import Steps
from vlatool.errors import DataError, require
from vlatool.files.bag_files import SUFFIXES, UNFINISHED_SUFFIX, bag_errors, refuse_unfinished
from vlatool.files.limits import check_limit
from vlatool.files.printable import amount
from vlatool.registry import Claim

Array = NDArray[Any]
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
ENCODINGS: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1),
    "8UC1": ("u1", 1), "8UC3": ("u1", 3), "8UC4": ("u1", 4), "mono16": ("u2", 1), "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
}  # fmt: skip
"""Encoding of sensor_msgs/Image -> type of a value, and channels; they are handed on in the order that is stored."""
TYPE_NAME = re.compile(r"[A-Za-z]\w{0,99}(/[A-Za-z]\w{0,99}){1,2}", re.ASCII)
FIELD_NAME = re.compile(r"[A-Za-z_]\w{0,199}", re.ASCII)
ACTIONS = ("action", "actions", "command", "cmd", "joint_command", "commands")
MIN_MESSAGES = 2
MAX_AGE_S = 0.2
"""Seconds that a message may be from the time of a row; the row is left out where it is further."""
RECORD_AGAIN = "record it again"


class Rosbag(StepReader):
    """Reads topics of pictures and of numbers; a bag is one episode, a directory of bags is several."""

    needs: ClassVar[str] = "a bag of ROS 2 (a directory with metadata.yaml, .mcap, .db3) or ROS 1 (.bag)"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a file by its suffix, and a directory that is a bag or holds bags."""
        if path.is_dir():
            return Claim.CERTAIN if _bags(path) else Claim.NONE
        return Claim.CERTAIN if path.name.endswith((*SUFFIXES, UNFINISHED_SUFFIX)) else Claim.NONE

    def steps(self, path: Path) -> Steps:
        """Return the topics, resampled at the times of the slowest camera: the nearest message of each.

        Raises:
            DataError: when a bag is corrupt, holds no usable topic, or bags have different topics.
            MissingExtra: when rosbags is not installed.
        """
        bags = [_read(bag) for bag in (_bags(path) if path.is_dir() else [path])]
        names = [*bags[0].columns]
        for bag in bags:
            if odd := {*bag.columns} ^ {*names}:
                raise DataError(
                    f"'{min(odd)}' is not in each bag of {path}.", "record the same topics in every episode"
                )
        columns: dict[str, Values] = {name: _joined(name, bags, path) for name in names}
        lengths = [len(bag.times) for bag in bags]
        times = np.concatenate([bag.times - bag.times[:1] for bag in bags])
        action = next((name for name in names if _topic_word(name) in ACTIONS), "")
        notes = tuple(dict.fromkeys(note for bag in bags for note in bag.notes))
        stamps = {name: np.concatenate([bag.stamps[name] - bag.times[:1] for bag in bags]) for name in bags[0].stamps
                  if all(name in bag.stamps for bag in bags)}  # fmt: skip
        episodes = np.repeat(np.arange(len(bags)), lengths)
        return Steps(path, columns, episodes, times, action, stamps=stamps, notes=notes)


def _topic_word(name: str) -> str:
    return name.partition(".")[0].rpartition("/")[2].lower()


def _bags(folder: Path) -> list[Path]:
    if (folder / "metadata.yaml").is_file():
        return [folder]
    files = [entry for entry in folder.iterdir() if entry.suffix in SUFFIXES or (entry / "metadata.yaml").is_file()]
    return sorted(files)


class _Bag:
    """An open bag, and the types of its messages.

    Args:
        path: a file, or the directory of a bag of ROS 2.
    """

    def __init__(self, path: Path) -> None:
        refuse_unfinished(path, DataError)
        self.path = path
        self._first = path.suffix == ".bag"
        reader: Any = require("rosbags.rosbag1" if self._first else "rosbags.rosbag2", "data")
        with bag_errors(path, DataError):
            self._reader = reader.Reader(path)
            self._reader.open()
            self.close = weakref.finalize(self, self._reader.close)
            self.connections = list(self._reader.connections)
            self._types = self._typestore()

    def _typestore(self) -> Any:
        """Return the types: those in the bag, of which each name was checked, since rosbags makes code of them."""
        systems: Any = require("rosbags.typesys", "data")
        types: dict[str, Any] = {}
        for connection in self.connections:
            if not TYPE_NAME.fullmatch(connection.msgtype):
                raise DataError(f"{self.path} has a type with the name {connection.msgtype[:60]!r}.", RECORD_AGAIN)
            if connection.msgdef.format.name == "MSG":
                types.update(systems.get_types_from_msg(connection.msgdef.data, connection.msgtype))
            elif connection.msgdef.format.name == "IDL":
                for part in connection.msgdef.data.split("=" * 80 + "\n"):
                    text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                    types.update(systems.get_types_from_idl(text) if text.strip() else {})
        if not types:
            return systems.get_typestore(systems.Stores.ROS1_NOETIC if self._first else systems.Stores.ROS2_HUMBLE)
        for name, (_, fields) in types.items():
            if not TYPE_NAME.fullmatch(name) or not all(FIELD_NAME.fullmatch(each) for each, _ in fields):
                raise DataError(f"{self.path} has a type with the name {name[:60]!r}, or fields of it.", RECORD_AGAIN)
        store = systems.get_typestore(systems.Stores.EMPTY)
        store.register({name: ([], fields) for name, (_, fields) in types.items()})
        return store

    def messages(self, topic: str = "", start: int | None = None) -> Iterator[tuple[Any, int, Any]]:
        """Yield connection, time of reception in ns, and message, in order; those of one topic, or all."""
        chosen = [each for each in self.connections if not topic or each.topic == topic]
        with bag_errors(self.path, DataError):
            for connection, time, content in self._reader.messages(connections=chosen, start=start):
                read = self._types.deserialize_ros1 if self._first else self._types.deserialize_cdr
                try:
                    message = read(content, connection.msgtype)
                except LIBRARY_ERRORS as error:
                    where = f"A message of {connection.topic} in {self.path} at {time} ns"
                    raise DataError(f"{where} cannot be read: {str(error)[:100]}.", RECORD_AGAIN) from error
                yield connection, time, message


@dataclass
class _Series:
    """Messages of one column: their times, and numbers, or when pictures were received."""

    stamps: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    received: list[int] = field(default_factory=list)
    topic: str = ""
    picture: Any = None


@dataclass(frozen=True)
class _Read:
    """A bag at common times."""

    times: Array
    columns: Mapping[str, Values]
    stamps: Mapping[str, Array]
    notes: tuple[str, ...]


def _read(path: Path) -> _Read:
    bag = _Bag(path)
    series: dict[str, _Series] = {}
    for connection, received, message in bag.messages():
        stamp = _stamp(message, received)
        if connection.msgtype in (IMAGE, COMPRESSED_IMAGE):
            one = series.setdefault(connection.topic, _Series(topic=connection.topic))
            one.picture = message if one.picture is None else one.picture
            one.stamps.append(stamp)
            one.received.append(received)
            continue
        for name, value in _numbers(message, connection.topic, path):
            one = series.setdefault(name, _Series(topic=connection.topic))
            one.stamps.append(stamp)
            one.values.append(value)
    bag.close()
    return _resample(path, series)


def _stamp(message: Any, received: int) -> float:
    """Return the time of a message in seconds: that of its header, else when it was received."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    seconds = 0.0 if stamp is None else float(stamp.sec) + float(stamp.nanosec) / 1e9
    return seconds or received / 1e9


def _numbers(message: Any, name: str, path: Path) -> Iterator[tuple[str, Array | str]]:
    """Yield the numbers of a message: ``topic.position``; one that has a single field of numbers is ``topic``."""
    found = [
        (key, value) for key, value in _leaves(message, "", 0) if not (isinstance(value, np.ndarray) and not value.size)
    ]
    if len(found) == 1 or [key for key, _ in found] == ["data"]:
        yield name, found[0][1]
        return
    for key, value in found:
        yield f"{name}.{key}", value


def _leaves(message: Any, prefix: str, depth: int) -> Iterator[tuple[str, Array | str]]:
    names = [name for name in getattr(message, "__dataclass_fields__", ()) if name not in ("header", "layout")]
    scalars = [name for name in names if isinstance(getattr(message, name), bool | int | float | np.number)]
    if scalars and depth:  # x, y, z of one thing are one vector
        yield prefix.rstrip("."), np.array([float(getattr(message, name)) for name in scalars])
    for name in names:
        value = getattr(message, name)
        if isinstance(value, np.ndarray):
            yield f"{prefix}{name}", value.astype(np.float64)
        elif isinstance(value, str):
            yield f"{prefix}{name}", value
        elif name in scalars:
            if not depth:
                yield f"{prefix}{name}", np.array([float(value)])
        elif hasattr(value, "__dataclass_fields__") and depth < 6:
            yield from _leaves(value, f"{prefix}{name}.", depth + 1)


def _resample(path: Path, series: Mapping[str, _Series]) -> _Read:
    """Take the nearest message of each column at the times of the slowest camera, or of the slowest column."""
    used = {name: one for name, one in series.items() if len(one.stamps) >= MIN_MESSAGES}
    once = {name: one for name, one in series.items() if name not in used}
    if not used:
        raise DataError(f"{path} holds no topic of pictures or numbers with {MIN_MESSAGES} messages.", RECORD_AGAIN)
    cameras = [one for one in used.values() if one.picture is not None]
    slowest = min(cameras or used.values(), key=lambda one: len(one.stamps))
    times = np.sort(np.array(slowest.stamps))
    check_limit("recorded_steps", len(times), str(path), DataError)
    nearest = {name: _nearest(np.array(one.stamps), times) for name, one in used.items()}
    ages = np.max([np.abs(np.array(used[name].stamps)[at] - times) for name, at in nearest.items()], axis=0)
    usable = ages <= MAX_AGE_S
    if not usable.any():
        raise DataError(f"{path} has no time at which every topic has a message within {MAX_AGE_S} s.", RECORD_AGAIN)
    columns: dict[str, Values] = {name: _column(path, name, one, nearest[name][usable]) for name, one in used.items()}
    columns |= {name: _column(path, name, one, np.zeros(int(usable.sum()), np.intp)) for name, one in once.items()}
    left_out = int((~usable).sum())
    note = (
        f"{path}: {left_out} of {amount(len(times), 'step')} are left out: a topic has no message within {MAX_AGE_S} s"
    )
    stamps = {name: np.array(one.stamps)[nearest[name][usable]] for name, one in used.items()}
    return _Read(times[usable], columns, stamps, (note,) if left_out else ())


def _nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    """Return the index of the stamp that is nearest to each time.

    Example:
        >>> _nearest(np.array([0.0, 1.0, 2.0]), np.array([0.4, 1.6, 9.0])).tolist()
        [0, 2, 2]
    """
    order = np.argsort(stamps, kind="stable")
    after = np.clip(np.searchsorted(stamps[order], times), 1, max(1, len(stamps) - 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    closer = np.abs(stamps[order][before] - times) <= np.abs(stamps[order][after] - times)
    return order[np.where(closer, before, after)]


def _column(path: Path, name: str, one: _Series, rows: NDArray[np.intp]) -> Values:
    if one.picture is None:
        if isinstance(one.values[0], str):
            return np.array(one.values)[rows]
        sizes = {value.shape for value in one.values}
        if len(sizes) > 1:
            raise DataError(f"'{name}' in {path} has messages of {sorted(sizes)} elements.", RECORD_AGAIN)
        return np.stack(one.values)[rows]
    first = _pixels(one.picture, f"'{name}' in {path}")
    pictures = _Pictures(path, one, f"'{name}' in {path}")
    return LazyRows(lambda at: pictures.fetch(rows[at]), (len(rows), *first.shape), first.dtype, f"'{name}' in {path}")


class _Pictures:
    """Reads pictures of a topic, in order wherever they are asked for in order."""

    def __init__(self, path: Path, series: _Series, where: str) -> None:
        self._path, self._series, self._where = path, series, where
        self._bag: _Bag | None = None
        self._next = -1
        self._iterator: Iterator[tuple[Any, int, Any]] = iter(())
        self._last: tuple[int, Array] = (-1, np.empty(0))

    def fetch(self, rows: NDArray[np.intp]) -> Array:
        """Return the pictures of some messages, by their number in the topic."""
        return stack_pictures([self._read(int(row)) for row in rows], self._where, rows)

    def _read(self, row: int) -> Array:
        if self._last[0] == row:
            return self._last[1]
        received = self._series.received
        if not self._next <= row or self._next < 0 or received[row] - received[self._next] > 2e9:
            self._next = next(at for at, time in enumerate(received) if time == received[row])
            self._bag = self._bag or _Bag(self._path)
            self._iterator = self._bag.messages(self._series.topic, received[row])
        for _, _, message in self._iterator:
            self._next += 1
            if self._next > row:
                self._last = (row, _pixels(message, self._where))
                return self._last[1]
        raise DataError(f"{self._where} was changed while it was read.", RECORD_AGAIN)


def _pixels(message: Any, where: str) -> Array:
    """Return the picture of a message as (height, width, channels), in the order of its encoding."""
    if not hasattr(message, "encoding"):
        return decode_picture(message.data.tobytes(), where)
    if message.encoding not in ENCODINGS:
        raise DataError(f"{where} has the encoding '{message.encoding[:40]}', which is not read.",
                        f"record one of {', '.join(ENCODINGS)}")  # fmt: skip
    kind, channels = ENCODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    if step < row or len(message.data) < height * step or not height * width:
        raise DataError(
            f"{where} says {width} x {height} {message.encoding}, {step} bytes a row; it holds {len(message.data)}.",
            RECORD_AGAIN,
        )
    lines = np.asarray(message.data[: height * step], np.uint8).reshape(height, step)[:, :row]
    return np.ascontiguousarray(lines).view(dtype).reshape(height, width, channels).astype(dtype.newbyteorder("="))


def _joined(name: str, bags: list[_Read], path: Path) -> Values:
    """Return a column of all bags."""
    parts = [bag.columns[name] for bag in bags]
    first = parts[0]
    if len(parts) == 1:
        return first
    odd = next((part for part in parts if part.shape[1:] != first.shape[1:]), None)
    if odd is not None:
        raise DataError(
            f"'{name}' in {path} is {list(first.shape[1:])} in one bag, and {list(odd.shape[1:])} in another.",
            "record every episode alike",
        )
    if not isinstance(first, LazyRows):
        return np.concatenate([np.asarray(part) for part in parts])
    ends = np.cumsum([len(part) for part in parts])

    def fetch(rows: NDArray[np.intp]) -> Array:
        at = np.searchsorted(ends, rows, side="right")
        return np.stack([parts[bag][int(row - ends[bag] + len(parts[bag]))] for bag, row in zip(at, rows, strict=True)])

    return LazyRows(fetch, (int(ends[-1]), *first.shape[1:]), first.dtype, f"'{name}' in {path}")
