"""The file of a recorded run: frames of JSON and arrays, each with a checksum that covers those before it.

``VLARUN1`` and a line feed, then frames: kind (1 byte), length of the content (4 bytes, little-endian), content, CRC-32
of all bytes since the magic (4 bytes). The content is the length of a JSON text (4 bytes), that text, and the bytes of
the arrays that it lists, in order. Python's ``repr`` of a float64 is exact, so JSON carries numbers bit for bit.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vlatool.errors import DataError
from vlatool.files.json import parse_json
from vlatool.files.limits import check_limit
from vlatool.runtime.interface import Array

MAGIC = b"VLARUN1\n"
HEAD, CHECKSUM, SIZE = struct.Struct("<BI"), struct.Struct("<I"), struct.Struct("<I")
DTYPES = frozenset(("bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
                    "float16", "float32", "float64"))  # fmt: skip
MOST_AXES = 32
OF_A_FUNCTION = "function"
"""Stands in a header for an envelope or a second policy that is none of a name."""


class FrameKind(IntEnum):
    """What a frame holds."""

    HEADER = 1
    TICK = 2
    CALL = 3
    END = 4


class Frame(NamedTuple):
    """One frame.

    Args:
        kind: What it holds.
        values: Plain values.
        arrays: Name -> array.
    """

    kind: FrameKind
    values: dict[str, Any]
    arrays: Mapping[str, Array]

    @property
    def size(self) -> int:
        """About how many bytes it takes."""
        return sum(array.nbytes for array in self.arrays.values())


@dataclass(frozen=True)
class RunHeader:
    """What a run is of.

    Args:
        policy: Identity of the bundle.
        engine: Engine of the runtime.
        threads: Threads of the engine; the cores of the process when None.
        seed: Seed of the noise.
        controllers: Names of entries of the kind ``control``.
        envelope: Robot whose limits were kept; empty without one, ``function`` where a function wrapped the controller.
        deadline_ms: Deadline; None without one.
        fallback: Options of the fallback, but its policy; None without one.
        second: Identity of the second bundle, ``function`` of a policy that is none; empty without one.
        version: Version of vlatool.
    """

    policy: str
    engine: str
    threads: int | None
    seed: int
    controllers: tuple[str, ...] = ()
    envelope: str = ""
    deadline_ms: float | None = None
    fallback: dict[str, Any] | None = None
    second: str = ""
    version: str = ""


class RunWriter:
    """Writes frames to a new file, whose beginning can be read whenever the process ends.

    Args:
        path: The file, which must not exist.

    Raises:
        DataError: when it cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        self._crc, self._path = 0, path
        self.size = 0
        """Bytes that were written."""
        try:
            self._handle = os.open(path, flags, 0o644)
            try:
                self._write(MAGIC)
            except OSError:
                os.close(self._handle)
                os.unlink(path)
                raise
        except OSError as error:
            raise DataError(
                f"{path} cannot be written: {error.strerror}.", "name a new file in a directory of yours"
            ) from None

    def append(self, frame: Frame, most: float = math.inf) -> bool:
        """Write a frame, unless the file would then be larger than ``most`` bytes; returns whether it was written.

        Raises:
            OSError: when the disk takes no more; names the file.
        """
        content, crc = _encoded(frame, self._crc)
        if self.size + len(content) > most:
            return False
        try:
            self._write(content)
        except OSError as error:
            raise OSError(error.errno, error.strerror, os.fspath(self._path)) from error
        self._crc = crc
        return True

    def _write(self, content: bytes) -> None:
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(self._handle, rest) :]
        self.size += len(content)

    def sync(self) -> None:
        """Flush what was written to the disk."""
        os.fsync(self._handle)

    def close(self) -> None:
        """Flush and close the file."""
        try:
            self.sync()
        finally:
            os.close(self._handle)


def _encoded(frame: Frame, crc: int) -> tuple[bytes, int]:
    """Return the bytes of a frame, and the checksum of all so far."""
    arrays = {name: np.ascontiguousarray(array) for name, array in frame.arrays.items()}
    listed = [[name, array.dtype.name, list(frame.arrays[name].shape)] for name, array in arrays.items()]
    text = json.dumps([frame.values, listed], separators=(",", ":")).encode()
    content = b"".join([SIZE.pack(len(text)), text, *(array.tobytes() for array in arrays.values())])
    whole = HEAD.pack(frame.kind, len(content)) + content
    crc = zlib.crc32(whole, crc)
    return whole + CHECKSUM.pack(crc), crc


def read_run(path: str | os.PathLike[str]) -> Iterator[Frame]:
    """Return the frames of a file, up to one that was not written to its end.

    Raises:
        DataError: when the file cannot be read or is none of a recorded run, at the first frame that is not as it was
            written, or where something follows its end.
    """
    try:
        with Path(path).open("rb") as file:
            left = os.fstat(file.fileno()).st_size - len(MAGIC)
            if file.read(len(MAGIC)) != MAGIC:
                raise DataError(f"{path} is not a recorded run.", "name a file that vlatool record has written")
            number, crc = 0, 0
            while (found := _next(file, left, crc, f"{path}: frame {number}")) is not None:
                frame, taken, crc = found
                _check_place(frame, number, f"{path}: frame {number}")
                yield frame
                left, number = left - taken, number + 1
                if frame.kind is FrameKind.END and left:
                    raise DataError(f"{path}: {left:,} bytes follow its end.", "use the frames before its end")
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.", "check the path") from None


def _next(file: Any, left: int, crc: int, where: str) -> tuple[Frame, int, int] | None:
    """Return a frame, its bytes and the checksum with it; None where the rest is shorter than a frame."""
    if left < HEAD.size:
        return None
    head = file.read(HEAD.size)
    kind, length = HEAD.unpack(head)
    taken = HEAD.size + length + CHECKSUM.size
    if taken > left:
        return None
    check_limit("run_frame_bytes", length, where, DataError)
    content = file.read(length)
    crc = zlib.crc32(content, zlib.crc32(head, crc))
    if file.read(CHECKSUM.size) != CHECKSUM.pack(crc):
        raise _damaged(where)
    try:
        return _decoded(FrameKind(kind), content), taken, crc
    except (ValueError, TypeError, struct.error, OverflowError):
        raise _damaged(where) from None


def _decoded(kind: FrameKind, content: bytes) -> Frame:
    """Return the frame of a content; raises ValueError and its like where it is none."""
    (size,) = SIZE.unpack_from(content)
    values, listed = parse_json(content[SIZE.size : SIZE.size + size], strict=True)
    offset, arrays = SIZE.size + size, {}
    for name, dtype, shape in listed:
        if not isinstance(name, str) or dtype not in DTYPES or name in arrays or len(shape) > MOST_AXES:
            raise ValueError("an array that is none")
        if not all(type(axis) is int and 0 <= axis <= len(content) for axis in shape):
            raise ValueError("a shape that is none")
        count = math.prod(shape)
        end = offset + count * np.dtype(dtype).itemsize
        if end > len(content):
            raise ValueError("an array beyond the end")
        arrays[name] = np.frombuffer(content, dtype, count, offset).reshape(shape)
        offset = end
    if offset != len(content) or not isinstance(values, dict):
        raise ValueError("more than the arrays")
    return Frame(kind, values, arrays)


def _check_place(frame: Frame, number: int, where: str) -> None:
    if (frame.kind is FrameKind.HEADER) is not (number == 0):
        raise _damaged(where)


def _damaged(where: str) -> DataError:
    return DataError(f"{where} is not as it was written.", "use the frames before it")
