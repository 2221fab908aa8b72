"""Untrusted NumPy archives: sizes are checked before anything is unpacked, and no Python object is ever unpickled."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError, VlatoolError
from vlatool.files.limits import MIB, check_limit
from vlatool.files.printable import amount
from vlatool.files.rows import CompressedSource, OpenFile, PlainSource, Rows

Array = NDArray[Any]
MAX_DIRECTORY_BYTES = MIB
"""Largest central directory of an archive: about twenty thousand names."""
MAX_HEADER_BYTES = 1 << 16
HEADER = re.compile(
    r"\{\s*'descr':\s*'(?P<descr>[<>=|]?[a-zA-Z]\d{0,9})',\s*'fortran_order':\s*(?P<fortran>True|False),"
    r"\s*'shape':\s*\((?P<shape>(?:\d{1,18},?\s*){0,64})\),?\s*\}\s*"
)
BLOCK_BYTES = MIB
SAVE_AGAIN = "write it again with np.savez"
MAX_IN_MEMORY_BYTES = 16 * MIB
LIBRARY_ERRORS = (
    OSError, ValueError, TypeError, KeyError, EOFError, NotImplementedError, RuntimeError, MemoryError,
    OverflowError, struct.error, zlib.error, zipfile.BadZipFile, zipfile.LargeZipFile,
)  # fmt: skip
"""What zipfile, zlib and numpy raise on damaged files."""


def open_npz(
    source: bytes | str | os.PathLike[str],
    allowed: str = "recording_bytes",
    *,
    where: str = "",
    error: type[VlatoolError] = DataError,
    fix: str = SAVE_AGAIN,
) -> dict[str, Array]:
    """Return the arrays of an ``.npz`` file by name.

    Args:
        source: path, or content of the file.
        allowed: name of the limit (``vlatool.files.limits``) on the total size of all arrays.
        where: name of the file in messages; its path when empty.
        fix: remedy for a file that cannot be read.

    Raises:
        DataError: (or ``error``) when the file cannot be read, is not an archive of arrays, holds Python objects, or
            would unpack to more than the limit.

    Example:
        >>> import io
        >>> buffer = io.BytesIO()
        >>> np.savez(buffer, a=np.arange(3))
        >>> open_npz(buffer.getvalue(), where="an example")["a"].tolist()
        [0, 1, 2]
    """
    where = where or ("the archive" if isinstance(source, bytes) else str(Path(source)))
    with _map_library_errors(where, error, fix), _archive(source) as archive:
        members = _members(archive, allowed, where, error, fix)
        return {name: _array(archive, member, name) for name, member in members.items()}


def open_rows(
    path: str | os.PathLike[str],
    allowed: str = "recording_bytes",
    in_memory: int = MAX_IN_MEMORY_BYTES,
    free: float | None = None,
) -> dict[str, Array | Rows]:
    """Return the arrays of an ``.npz`` file by name, large ones as ``Rows``, which stay on the disk.

    The whole file is read once, in blocks: a damaged one is refused here and not later.

    Args:
        allowed: name of the limit on the total size of all arrays.
        in_memory: size of the largest array of numbers that is held in memory. Text, and arrays in Fortran's order, in
            which a row is scattered, are held in memory whatever their size.
        free: bytes of memory that those may take in total; None when unknown.

    Raises:
        DataError: as ``open_npz`` does, and when the memory does not suffice.
    """
    where = str(Path(path))
    with _map_library_errors(where), _archive(path) as archive:
        file = OpenFile.at(path, where)
        members = _members(archive, allowed, where)
        stay = {name: _stays_on_disk(archive, member, name, in_memory) for name, member in members.items()}
        _refuse_beyond(where, sum(member.file_size for name, member in members.items() if not stay[name]), free)
        return {
            name: _rows(archive, member, name, file) if stay[name] else _array(archive, member, name)
            for name, member in members.items()
        }


def _refuse_beyond(where: str, needed: int, free: float | None) -> None:
    if free is not None and needed > free:
        raise DataError(
            f"{where} takes {needed / 1e6:,.0f} MB of memory, unpacked; {free / 1e6:,.0f} MB are free.",
            "record fewer samples, or use a machine with more memory",
        )


@contextlib.contextmanager
def _archive(source: bytes | str | os.PathLike[str]) -> Iterator[zipfile.ZipFile]:
    with _stream(source) as stream, zipfile.ZipFile(_with_small_directory(stream)) as archive:
        yield archive


@contextlib.contextmanager
def _map_library_errors(where: str, error: type[VlatoolError] = DataError, fix: str = SAVE_AGAIN) -> Iterator[None]:
    """Turn what zipfile, zlib and numpy raise into an error of one sentence."""
    try:
        yield
    except VlatoolError:
        raise
    except LIBRARY_ERRORS as foreign:
        reason = f"{foreign.strerror}" if isinstance(foreign, OSError) and foreign.strerror else _first_line(foreign)
        raise error(f"{where} cannot be read: {reason}.", fix) from foreign


def _first_line(error: BaseException) -> str:
    return (str(error).strip().rstrip(".").splitlines() or [type(error).__name__])[0][:200] or type(error).__name__


@contextlib.contextmanager
def _stream(source: bytes | str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a regular file; a pipe would never end."""
    if isinstance(source, bytes):
        yield io.BytesIO(source)
        return
    handle = os.open(source, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as stream:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise ValueError("it is not a regular file")
        yield stream


def _with_small_directory(stream: IO[bytes]) -> IO[bytes]:
    """Refuse a table of contents whose entries alone would fill the memory, before zipfile reads it."""
    size = stream.seek(0, os.SEEK_END)
    start = max(0, size - (1 << 16) - 128)
    stream.seek(start)
    tail = stream.read()
    if tail[:6] == b"\x93NUMPY" and not start:
        raise ValueError("it is one array, not an archive of named arrays")
    end = len(tail) - 22
    if end < 0 or tail[end : end + 4] != b"PK\5\6" or tail[-2:] != b"\0\0":
        end = tail.rfind(b"PK\5\6")
    if end < 0 or end + 22 > len(tail):
        raise ValueError("it is not a zip archive, or its end is missing")
    sizes = [struct.unpack_from("<I", tail, end + 12)[0]]
    if b"PK\6\7" in tail[:end]:
        starts = (at for at in _find_all(tail, b"PK\6\6") if at + 48 <= len(tail))
        sizes = [struct.unpack_from("<Q", tail, at + 40)[0] for at in starts]
    if max(sizes, default=0) > MAX_DIRECTORY_BYTES:
        raise ValueError(f"its table of contents has {amount(max(sizes), 'byte')}; allowed: {MAX_DIRECTORY_BYTES}")
    stream.seek(0)
    return stream


def _find_all(text: bytes, part: bytes) -> Iterator[int]:
    at = text.find(part)
    while at >= 0:
        yield at
        at = text.find(part, at + 1)


def _members(
    archive: zipfile.ZipFile, allowed: str, where: str, error: type[VlatoolError] = DataError, fix: str = SAVE_AGAIN
) -> dict[str, zipfile.ZipInfo]:
    """Return array name -> entry, once the declared sizes are within the limits."""
    entries = archive.infolist()
    check_limit("arrays", len(entries), where, error)
    check_limit(allowed, sum(entry.file_size for entry in entries), f"{where}, unpacked,", error)
    members: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name == entry.filename or name in members:
            raise error(f"{where} has the entry '{entry.filename[:80]}' twice, or it is not an array (NAME.npy).", fix)
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & 1:
            raise error(f"{where} has '{name[:80]}' encrypted or packed in a way that numpy does not write.", fix)
        members[name] = entry
    return members


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> Array:
    with archive.open(entry) as stream:
        shape, fortran, dtype, _ = _checked_header(stream, entry, name)
        array = np.empty(math.prod(shape), dtype)
        _fill(stream, array, name)
    return check_values(array, name).reshape(shape, order="F" if fortran else "C")


def _stays_on_disk(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, in_memory: int) -> bool:
    """Return whether an array stays on the disk: it is large, and its rows are contiguous."""
    with archive.open(entry) as stream:
        shape, fortran, dtype, _ = _checked_header(stream, entry, name)
    return bool(shape and shape[0]) and not fortran and dtype.kind not in "SU" and entry.file_size > in_memory


def _rows(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, file: OpenFile) -> Rows:
    """Return the rows of an array, after a pass over all of its bytes found them valid."""
    with archive.open(entry) as stream:
        shape, _, dtype, start = _checked_header(stream, entry, name)
        while block := stream.read(BLOCK_BYTES):  # the end compares the checksum
            if dtype.kind == "b":
                check_values(np.frombuffer(block, np.bool_), name)
    where, size = f"'{name}' in {file.where}", entry.file_size - start
    if entry.compress_type == zipfile.ZIP_STORED:
        return Rows(PlainSource(file, _data_start(file, entry) + start), shape, dtype, where)
    return Rows(CompressedSource(file, entry.filename, start, size), shape, dtype, where)


def _data_start(file: OpenFile, entry: zipfile.ZipInfo) -> int:
    """Return the offset of an entry's data: after its local header, whose name and extra field have their own sizes."""
    header = bytearray(30)
    file.read_into(memoryview(header), entry.header_offset)
    name, extra = struct.unpack_from("<HH", header, 26)
    return entry.header_offset + len(header) + int(name) + int(extra)


def _checked_header(
    stream: IO[bytes], entry: zipfile.ZipInfo, name: str
) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return shape, whether it is in Fortran's order, dtype and bytes of the header of an array of numbers or text."""
    shape, fortran, dtype = npy_header(stream)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are refused")
    if dtype.kind not in "biufcSU" or not dtype.itemsize:
        raise ValueError(f"'{name}' has the dtype {dtype}, which is neither numbers nor text")
    start = stream.tell()
    if start + math.prod(shape) * dtype.itemsize != entry.file_size:
        raise ValueError(
            f"'{name}' declares the shape {str(shape)[:80]}, but has {amount(entry.file_size - start, 'byte')}"
        )
    return shape, fortran, dtype, start


def npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, whether it is in Fortran's order, and dtype of an array; nothing of the header is evaluated."""
    start = stream.read(8)
    size = {b"\1": 2, b"\2": 4}.get(start[6:7], 0)
    if start[:6] != b"\x93NUMPY" or not size:
        raise ValueError("an entry is not an array in the .npy format 1 or 2")
    length = int.from_bytes(stream.read(size), "little")
    if length > MAX_HEADER_BYTES:
        raise ValueError(f"the header of an array has {amount(length, 'byte')}; allowed: {MAX_HEADER_BYTES}")
    match = HEADER.fullmatch(stream.read(length).decode("latin-1"))
    if match is None:
        raise ValueError("the header of an array is not one of plain numbers or text")
    shape = tuple(int(axis) for axis in match["shape"].replace(" ", "").split(",") if axis)
    return shape, match["fortran"] == "True", np.dtype(match["descr"])


def _fill(stream: IO[bytes], array: Array, name: str) -> None:
    """Read blocks into the array: it is in memory once."""
    view = array.view(np.uint8).data if array.size else memoryview(b"")
    done = 0
    while done < len(view):
        block = stream.read(min(BLOCK_BYTES, len(view) - done))
        if not block:
            raise ValueError(f"'{name}' ends early")
        view[done : done + len(block)] = block
        done += len(block)
    if stream.read(1):
        raise ValueError(f"'{name}' has more bytes than its shape")


def check_values(array: Array, name: str) -> Array:
    """Return the array in native byte order; refuse bytes that are not a valid value of their dtype."""
    native = array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
    if native.dtype.kind == "U" and native.size:
        codes = native.view(np.uint32)
        if codes.max() > 0x10FFFF or bool(((codes >= 0xD800) & (codes <= 0xDFFF)).any()):
            raise ValueError(f"'{name}' holds text that is not valid Unicode")
    if native.dtype.kind == "b" and native.size and int(native.view(np.uint8).max()) > 1:
        raise ValueError(f"'{name}' holds truth values that are neither 0 nor 1")
    return native
