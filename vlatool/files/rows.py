"""A large array of an ``.npz`` file that stays on the disk: rows are read as they are asked for."""

from __future__ import annotations

import io
import math
import os
import tempfile
import weakref
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError

Array = NDArray[Any]
BLOCK = 1 << 22
"""Bytes that are looked at together."""
REWINDS = 2
"""How often a packed array is unpacked from its start before it is kept unpacked."""


class OpenFile:
    """A file that stays open, whatever its name leads to later, as long as somebody reads from it."""

    def __init__(self, handle: int, where: str) -> None:
        self.handle = handle
        self.where = where
        weakref.finalize(self, os.close, handle)

    @classmethod
    def at(cls, path: str | os.PathLike[str], where: str = "") -> OpenFile:
        """Open a file for reading."""
        return cls(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), where or str(Path(path)))

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer from a place in the file; return the bytes that there were."""
        done = 0
        while done < len(buffer) and (count := os.preadv(self.handle, [buffer[done:]], at + done)):
            done += count
        return done


class _Stream(io.RawIOBase):
    """An open file with a position of its own, which no other reader and no child process moves."""

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
    """Where the bytes of an array are."""

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer with the bytes from a place in the array; return how many there were."""


class Plain:
    """An array that lies unpacked in a file.

    Args:
        file: Where it lies.
        start: Bytes before its first element.
    """

    def __init__(self, file: OpenFile, start: int) -> None:
        self._file = file
        self._start = start

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer with the bytes from a place in the array; return how many there were."""
        return self._file.read_into(buffer, self._start + at)


class Packed:
    """An array that is deflated: unpacked while it is read in order, into a file without a name when it is not.

    Args:
        file: The archive.
        entry: Name of the entry.
        start: Bytes of the array's header.
        size: Bytes of its elements.
    """

    def __init__(self, file: OpenFile, entry: str, start: int, size: int) -> None:
        self._file, self._entry, self._start, self._size = file, entry, start, size
        self._stream: Any = None
        self._at = 0
        self._rewinds = 0
        self._plain: Plain | None = None

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer with the bytes from a place in the array; return how many there were."""
        if self._stream is None or at < self._at:
            self._rewind()
        if self._plain is not None:
            return self._plain.read_into(buffer, at)
        while self._at < at and (skipped := self._stream.read(min(BLOCK, at - self._at))):
            self._at += len(skipped)
        done = 0
        while done < len(buffer) and (block := self._stream.read(min(BLOCK, len(buffer) - done))):
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
        if self._rewinds > REWINDS:
            self._plain = self._unpacked()

    def _unpacked(self) -> Plain:
        handle, name = tempfile.mkstemp(prefix="vlatool-rows-")
        os.unlink(name)
        kept = OpenFile(handle, self._file.where)
        try:
            while block := self._stream.read(BLOCK):
                left = memoryview(block)
                while left:  # a disk that is nearly full takes a part
                    left = left[os.write(handle, left) :]
        except OSError as error:
            raise DataError(
                f"{self._file.where} is packed and is read out of order, for which {Path(name).parent} would need "
                f"{self._size / 1e6:,.0f} MB: {error.strerror}.",
                "write it with np.savez instead of np.savez_compressed, or set TMPDIR to a place with more room",
            ) from error
        return Plain(kept, 0)


class Chosen:
    """Some rows of an array, as if they were all that there are.

    Args:
        source: Where the array is.
        places: Number of each row in it, ascending.
        row: Bytes of a row.
    """

    def __init__(self, source: Source, places: NDArray[np.intp], row: int) -> None:
        self._source, self._places, self._row = source, places, row

    def read_into(self, buffer: memoryview, at: int) -> int:
        """Fill a buffer with the bytes from the start of one of the rows; return how many there were."""
        done = 0
        first = at // self._row
        for place in self._places[first : first + math.ceil(len(buffer) / self._row)]:
            part = buffer[done : done + self._row]
            done += self._source.read_into(part, int(place) * self._row)
        return done


class Rows:
    """An array on the disk whose first axis counts samples; what is asked for is read, and nothing is kept.

    Args:
        source: Where its bytes are, in C order.
        shape: With the axis of samples first.
        dtype: As stored; rows come in this machine's byte order.
        where: What it is called in messages.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.bin"
        >>> _ = path.write_bytes(np.arange(6, dtype=np.int16).tobytes())
        >>> rows = Rows(Plain(OpenFile.at(path), 0), (3, 2), np.dtype(np.int16), "a")
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
        """Return one row, or the rows at several places, as an array in memory.

        Raises:
            IndexError: where there is no row.
            DataError: when the file became shorter since it was opened.
        """
        if isinstance(at, Sequence):
            return np.stack([self[index] for index in at]) if at else np.empty((0, *self.shape[1:]), self.dtype)
        number = range(len(self))[at]
        row: Array = self.read(number, 1)[0]
        return row

    def read(self, first: int, count: int) -> Array:
        """Return ``count`` rows from ``first`` on.

        Raises:
            DataError: when the file became shorter since it was opened.
        """
        array = np.empty((count, *self.shape[1:]), self._stored)
        room = array.reshape(-1).view(np.uint8).data
        if array.nbytes and self._source.read_into(room, first * (array.nbytes // count)) < array.nbytes:
            raise DataError(f"{self.where} was changed while it was read.", "run it again once nothing writes there")
        return array.astype(self.dtype, copy=False)

    def only(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return the rows that are chosen, which stay on the disk too.

        Args:
            chosen: (N,) of each row.
        """
        places = np.flatnonzero(chosen)
        row = math.prod(self.shape[1:]) * self._stored.itemsize
        return Rows(Chosen(self._source, places, row), (len(places), *self.shape[1:]), self._stored, self.where)

    def without_second_axis(self) -> Rows:
        """Return the same rows where each has a further axis of one element in front."""
        return Rows(self._source, (self.shape[0], *self.shape[2:]), self._stored, self.where)


def blocks(values: Array | Rows) -> Iterator[tuple[int, Array]]:
    """Yield the number of a first row and rows from there on, a few megabytes at a time.

    Example:
        >>> [(first, block.tolist()) for first, block in blocks(np.arange(3))]
        [(0, [0, 1, 2])]
    """
    row = math.prod(values.shape[1:]) * values.dtype.itemsize
    step = max(1, BLOCK // max(1, row))
    for first in range(0, len(values), step):
        if isinstance(values, Rows):
            yield first, values.read(first, min(step, len(values) - first))
        else:
            yield first, values[first : first + step]
