"""Large arrays of an ``.npz`` file that stay on the disk: rows are read on request."""

from __future__ import annotations

import io
import math
import os
import weakref
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError

Array = NDArray[Any]
BLOCK_BYTES = 1 << 22
"""Bytes that are read at a time."""
MAX_REWINDS = 2
"""Number of times a compressed array is decompressed from its start before it is stored decompressed."""


class OpenFile:
    """A file that stays open as long as it is referenced, whatever happens to its path."""

    def __init__(self, handle: int, where: str) -> None:
        self.handle = handle
        self.where = where
        weakref.finalize(self, os.close, handle)

    @classmethod
    def at(cls, path: str | os.PathLike[str], where: str = "") -> OpenFile:
        """Open a file for reading."""
        return cls(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), where or str(Path(path)))

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer from an offset in the file; return the number of bytes read."""
        done = 0
        while done < len(buffer) and (count := os.preadv(self.handle, [buffer[done:]], at + done)):
            done += count
        return done


class _Stream(io.RawIOBase):
    """An open file with its own position, which no other reader and no child process moves."""

    def __init__(self, file: OpenFile) -> None:
        self._file = file
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._at}.get(whence, os.fstat(self._file.handle).st_size)
        self._at = base + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        count = self._file.read_into(memoryview(buffer).cast("B"), self._at)
        self._at += count
        return count


class Source(Protocol):
    """Source of the bytes of an array."""

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer from an offset in the array; return the number of bytes read."""


class PlainSource:
    """An uncompressed array in a file, from the offset ``start`` on."""

    def __init__(self, file: OpenFile, start: int) -> None:
        self._file = file
        self._start = start

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer from an offset in the array; return the number of bytes read."""
        return self._file.read_into(buffer, self._start + at)


class CompressedSource:
    """A deflated array: decompressed while it is read in order, and into an anonymous file when it is not.

    Args:
        file: the archive.
        start: size of the array's header in bytes.
        size: size of its elements in bytes.
    """

    def __init__(self, file: OpenFile, entry: str, start: int, size: int) -> None:
        self._file, self._entry, self._start, self._size = file, entry, start, size
        self._stream: Any = None
        self._at = 0
        self._rewinds = 0
        self._plain: PlainSource | None = None

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer from an offset in the array; return the number of bytes read."""
        if self._stream is None or at < self._at:
            self._rewind()
        if self._plain is not None:
            return self._plain.read_into(buffer, at)
        while self._at < at and (skipped := self._stream.read(min(BLOCK_BYTES, at - self._at))):
            self._at += len(skipped)
        done = 0
        while done < len(buffer) and (block := self._stream.read(min(BLOCK_BYTES, len(buffer) - done))):
            buffer[done : done + len(block)] = block
            done += len(block)
        self._at += done
        return done

    def _rewind(self) -> None:
        if self._plain is not None:
            return
        archive = zipfile.ZipFile(io.BufferedReader(_Stream(self._file)))
        self._stream = archive.open(self._entry)
        self._stream.read(self._start)
        self._at = 0
        self._rewinds += 1
        if self._rewinds > MAX_REWINDS:
            self._plain = self._unpack()

    def _unpack(self) -> PlainSource:
        import tempfile  # a robot keeps no recordings

        handle, name = tempfile.mkstemp(prefix="vlatool-rows-")
        os.unlink(name)
        kept = OpenFile(handle, self._file.where)
        try:
            while block := self._stream.read(BLOCK_BYTES):
                left = memoryview(block)
                while left:  # a disk that is nearly full accepts a part
                    left = left[os.write(handle, left) :]
        except OSError as error:
            raise DataError(
                f"{self._file.where} is compressed and is read out of order, for which {Path(name).parent} would need "
                f"{self._size / 1e6:,.0f} MB: {error.strerror}.",
                "write it with np.savez instead of np.savez_compressed, or set TMPDIR to a place with more room",
            ) from error
        return PlainSource(kept, 0)


class RowSubset:
    """A subset of the rows of an array.

    Args:
        indices: index of each row, ascending.
        row: size of a row in bytes.
    """

    def __init__(self, source: Source, indices: NDArray[np.intp], row: int) -> None:
        self._source, self._indices, self._row = source, indices, row

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer from the start of a row; return the number of bytes read."""
        done = 0
        first = at // self._row
        for index in self._indices[first : first + math.ceil(len(buffer) / self._row)]:
            part = buffer[done : done + self._row]
            done += self._source.read_into(part, int(index) * self._row)
        return done


class Rows:
    """An array on the disk whose first axis counts samples; rows are read on request, and not cached.

    Args:
        source: source of its bytes, in C order.
        shape: shape, with the axis of samples first.
        dtype: dtype as stored; rows are returned in native byte order.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.bin"
        >>> _ = path.write_bytes(np.arange(6, dtype=np.int16).tobytes())
        >>> rows = Rows(PlainSource(OpenFile.at(path), 0), (3, 2), np.dtype(np.int16), "a")
        >>> len(rows), rows[1].tolist(), rows[[0, 2]].tolist()
        (3, [2, 3], [[0, 1], [4, 5]])
    """

    def __init__(self, source: Source, shape: tuple[int, ...], dtype: np.dtype[Any], where: str) -> None:
        self._source = source
        self._stored = dtype
        self.shape = shape
        self.dtype = dtype.newbyteorder("=")
        self.where = where

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, at: int | Sequence[int]) -> Array:
        """Return one row, or the rows at several indices, as an array in memory.

        Raises:
            IndexError: when an index is out of range.
            DataError: when the file has become shorter since it was opened.
        """
        if isinstance(at, Sequence):
            return np.stack([self[index] for index in at]) if at else np.empty((0, *self.shape[1:]), self.dtype)
        number = range(len(self))[at]
        row: Array = self.read(number, 1)[0]
        return row

    def read(self, first: int, count: int) -> Array:
        """Return ``count`` rows from ``first`` on; raises DataError when the file became shorter since opening."""
        array = np.empty((count, *self.shape[1:]), self._stored)
        room = array.reshape(-1).view(np.uint8).data
        if array.nbytes and self._source.read_into(room, first * (array.nbytes // count)) < array.nbytes:
            raise DataError(f"{self.where} was changed while it was read.", "run it again once nothing writes there")
        return array.astype(self.dtype, copy=False)

    def select(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return the rows of a mask (N,), which stay on the disk, too."""
        indices = np.flatnonzero(chosen)
        row = math.prod(self.shape[1:]) * self._stored.itemsize
        return Rows(RowSubset(self._source, indices, row), (len(indices), *self.shape[1:]), self._stored, self.where)

    def without_second_axis(self) -> Rows:
        """Return the same rows without their second axis, which has one element."""
        return Rows(self._source, (self.shape[0], *self.shape[2:]), self._stored, self.where)


def blocks(values: Array | Rows) -> Iterator[tuple[int, Array]]:
    """Yield the index of a first row and the rows from there on, a few megabytes at a time.

    Example:
        >>> [(first, block.tolist()) for first, block in blocks(np.arange(3))]
        [(0, [0, 1, 2])]
    """
    row = math.prod(values.shape[1:]) * values.dtype.itemsize
    step = max(1, BLOCK_BYTES // max(1, row))
    for first in range(0, len(values), step):
        if isinstance(values, Rows):
            yield first, values.read(first, min(step, len(values) - first))
        else:
            yield first, values[first : first + step]


def in_memory(values: Array | Rows) -> Array:
    """Return all rows as an array in memory."""
    return values.read(0, len(values)) if isinstance(values, Rows) else values
