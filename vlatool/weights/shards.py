"""Weights in safetensors shards, read in parts, without memory maps and around the page cache."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import math
import mmap
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import SourceError
from vlatool.files.json import parse_json
from vlatool.files.small_file import read_bounded
from vlatool.files.validate import path_problem, short_repr

READ_FIX = "check its permissions and its disk"

Array = NDArray[Any]
ITEM_BYTES = {
    "BOOL": 1, "U8": 1, "I8": 1, "F8_E4M3": 1, "F8_E5M2": 1, "I16": 2, "U16": 2, "F16": 2, "BF16": 2,
    "I32": 4, "U32": 4, "F32": 4, "I64": 8, "U64": 8, "F64": 8,
}  # fmt: skip
FLOATS = ("F32", "F16", "BF16")
"""Dtypes that a weight to quantize may have."""
NUMPY_NAMES = {"bool": "BOOL", "float32": "F32", "float16": "F16", "bfloat16": "BF16", "float64": "F64"} | {
    f"{kind}int{bits}": f"{letter}{bits}" for kind, letter in (("", "I"), ("u", "U")) for bits in (8, 16, 32, 64)
}
INDEX = ".safetensors.index.json"
PAGE = 4096
MAX_HEADER_BYTES = 100_000_000
MIN_DIRECT_BYTES = 1 << 20
"""Smallest read that bypasses the page cache."""
DOWNLOAD_FIX = "download or copy the weights again"


@dataclass(frozen=True)
class StoredTensor:
    """Location of one tensor.

    Args:
        file: File that holds it; only for messages when ``array`` is given.
        offset: First byte in the file.
        dtype: Safetensors dtype: ``BF16``, ``F32`` ...
        array: Bytes of a tensor in memory, (bytes,) uint8.
    """

    name: str
    file: Path
    offset: int
    dtype: str
    shape: tuple[int, ...]
    array: Array | None = field(default=None, compare=False, repr=False)

    @property
    def count(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def item_bytes(self) -> int:
        """Bytes of one element."""
        return ITEM_BYTES[self.dtype]

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor."""
        return self.count * self.item_bytes


def stored_array(name: str, array: Array, file: Path) -> StoredTensor:
    """Return a stored tensor for an array in memory."""
    raw = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return StoredTensor(name, file, 0, NUMPY_NAMES[str(array.dtype)], array.shape, raw)


def shard_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a glob below the policy's folder, sorted; raises SourceError when there is none."""
    files = sorted(path for path in folder.glob(pattern) if path.is_file())
    if not files:
        raise SourceError(f"No file in {folder} matches 'weights: {pattern}'.", DOWNLOAD_FIX)
    return files


def read_shards(folder: Path, pattern: str) -> dict[str, StoredTensor]:
    """Read the headers of all shards: name -> location of the tensor, in the order of files and offsets.

    Raises:
        SourceError: when a shard is missing, truncated or not a safetensors file, or a tensor occurs twice.
    """
    files = shard_files(folder, pattern)
    _check_indexes(files)
    tensors: dict[str, StoredTensor] = {}
    for file in files:
        for tensor in sorted(read_header(file), key=lambda entry: entry.offset):
            if tensor.name in tensors:
                raise SourceError(
                    f"The tensor '{tensor.name}' is in {tensors[tensor.name].file.name} and in {file.name}.",
                    "keep one set of shards in the folder",
                )
            tensors[tensor.name] = tensor
    return tensors


def _check_indexes(files: list[Path]) -> None:
    """Check that every shard in an index next to the shards exists and holds the tensors of the index."""
    for index in sorted({path for file in files for path in file.parent.glob(f"*{INDEX}")}):
        try:
            weight_map = parse_json(read_bounded(index, "statistics_bytes", SourceError))["weight_map"]
            files_of = {str(tensor): str(file) for tensor, file in weight_map.items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise SourceError(f"{index} is not an index of safetensors shards: {error!r}.", DOWNLOAD_FIX) from error
        for name in sorted(set(files_of.values())):
            if reason := path_problem(name):
                raise SourceError(f"{index} names the shard {short_repr(name)}: {reason}.", DOWNLOAD_FIX)
            if not (index.parent / name).is_file():
                raise SourceError(f"{index} names the shard {name}, which is missing.", DOWNLOAD_FIX)
        held = {name: {tensor.name for tensor in read_header(index.parent / name)} for name in set(files_of.values())}
        for tensor, name in files_of.items():
            if tensor not in held[name]:
                raise SourceError(f"{index} says that '{tensor}' is in {name}, which does not hold it.", DOWNLOAD_FIX)


def read_header(file: Path) -> list[StoredTensor]:
    """Return the tensors of a safetensors file from its header; raises SourceError with the fault of the file."""
    header, start, size = _header_bytes(file)
    try:
        entries = parse_json(header)
    except ValueError as error:
        raise SourceError(f"{file} has a damaged safetensors header: {error}.", DOWNLOAD_FIX) from error
    if not isinstance(entries, Mapping):
        raise SourceError(f"{file} has a damaged safetensors header: it is not a mapping.", DOWNLOAD_FIX)
    tensors = [_entry(file, name, entry, start, size) for name, entry in entries.items() if name != "__metadata__"]
    for one, two in itertools.pairwise(sorted(tensors, key=lambda tensor: (tensor.offset, tensor.nbytes))):
        if one.offset + one.nbytes > two.offset:
            raise SourceError(
                f"{file} has a damaged safetensors header: '{one.name}' and '{two.name}' overlap.", DOWNLOAD_FIX
            )
    return tensors


def _header_bytes(file: Path) -> tuple[bytes, int, int]:
    """Return the header, the offset of the data, and the size of the file."""
    try:
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            length = struct.unpack("<Q", stream.read(8))[0] if size >= 8 else 0
            if not 2 <= length <= min(size - 8, MAX_HEADER_BYTES):
                raise SourceError(
                    f"{file} is not a safetensors file, or is cut off: {size} bytes cannot hold a header of {length}.",
                    DOWNLOAD_FIX,
                )
            return stream.read(length), 8 + length, size
    except OSError as error:
        raise SourceError(f"{file} cannot be read: {error.strerror}.", READ_FIX) from error


def _entry(file: Path, name: str, entry: Any, start: int, size: int) -> StoredTensor:
    try:
        dtype, shape = str(entry["dtype"]), _whole_numbers(entry["shape"])
        begin, end = _whole_numbers(entry["data_offsets"])
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{file} has a damaged safetensors header at '{name}': {error!r}.", DOWNLOAD_FIX) from error
    if dtype not in ITEM_BYTES:
        raise SourceError(
            f"{file} holds '{name}' as {dtype}; known dtypes: {', '.join(ITEM_BYTES)}.", "store it in one of these"
        )
    tensor = StoredTensor(name, file, start + begin, dtype, shape)
    if min((0, *shape)) < 0 or begin < 0 or end - begin != tensor.nbytes:
        raise SourceError(
            f"{file} has a damaged safetensors header: '{name}' {list(shape)} {dtype} cannot take {end - begin} bytes.",
            DOWNLOAD_FIX,
        )
    if start + end > size:
        raise SourceError(f"{file} is cut off: it has {size} bytes, '{name}' ends at {start + end}.", DOWNLOAD_FIX)
    return tensor


def _whole_numbers(values: Any) -> tuple[int, ...]:
    """Return a list of a header as a tuple; raises ValueError for anything but whole numbers."""
    if not isinstance(values, list) or not all(type(value) is int for value in values):
        raise ValueError(f"{short_repr(values)} is not a list of whole numbers")
    return tuple(values)


def fingerprint(files: list[Path]) -> str:
    """Return a SHA-256 over name, size, modification time and header of files: it changes with the weights."""
    digest = hashlib.sha256()
    for file in files:
        state = file.stat()
        digest.update(f"{file.name}:{state.st_size}:{state.st_mtime_ns}:".encode())
        digest.update(_header_bytes(file)[0] if file.suffix == ".safetensors" else b"")
    return digest.hexdigest()


def sampled_hash(files: list[Path]) -> str:
    """Return a SHA-256 over name, size, header and the first 4 KiB of every tensor of shards.

    It is the same for a copy, and different for retrained weights; it can miss a change of single elements deep inside
    a tensor, which hashing all of 13 GB would not, in ten times the time.
    """
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name}:{file.stat().st_size}:".encode())
        with file.open("rb") as stream:
            for tensor in read_header(file):
                digest.update(f"{tensor.name}:{tensor.dtype}:{tensor.shape}:".encode())
                stream.seek(tensor.offset)
                digest.update(stream.read(min(PAGE, tensor.nbytes)))
    return digest.hexdigest()


class Reader:
    """Reads parts of tensors into one buffer; for one thread. Large reads bypass the page cache where possible."""

    def __init__(self) -> None:
        self._files: dict[tuple[Path, bool], int] = {}
        self._buffer: mmap.mmap | None = None

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def read(self, tensor: StoredTensor, begin: int, size: int) -> Array:
        """Return bytes ``begin`` to ``begin + size`` of a tensor as (size,) uint8, valid until the next call.

        Raises:
            SourceError: when the file is shorter than its header says, or cannot be read.
        """
        if tensor.array is not None:
            return tensor.array[begin : begin + size]
        start = tensor.offset + begin
        aligned = start - start % PAGE
        length = -(-(start + size - aligned) // PAGE) * PAGE
        buffer = self._sized_buffer(length)
        try:
            got = self._fill(tensor.file, memoryview(buffer)[:length], aligned, start + size - aligned)
        except OSError as error:
            raise SourceError(f"{tensor.file} cannot be read: {error.strerror}.", READ_FIX) from error
        if got < start + size - aligned:
            raise SourceError(f"{tensor.file} is cut off: it ends within '{tensor.name}'.", DOWNLOAD_FIX)
        return np.frombuffer(buffer, np.uint8, size, start - aligned)

    def _sized_buffer(self, size: int) -> mmap.mmap:
        if self._buffer is None or len(self._buffer) < size:
            self._buffer = mmap.mmap(-1, size)
        return self._buffer

    def _fill(self, file: Path, view: memoryview, offset: int, needed: int) -> int:
        direct = len(view) >= MIN_DIRECT_BYTES
        got = 0
        while got < needed:
            try:
                step = os.preadv(self._open(file, direct), [view[got:]], offset + got)
            except OSError as error:
                if not direct or error.errno != errno.EINVAL:
                    raise
                direct = False
                continue
            if step <= 0:
                break
            got += step
            direct = direct and got % PAGE == 0
        return got

    def _open(self, file: Path, direct: bool) -> int:
        key = (file, direct)
        if key not in self._files:
            self._files[key] = open_direct(file, os.O_RDONLY) if direct else os.open(file, os.O_RDONLY)
        return self._files[key]

    def close(self) -> None:
        """Close all files."""
        for handle in self._files.values():
            with contextlib.suppress(OSError):
                os.close(handle)
        self._files.clear()


def open_direct(file: Path, flags: int) -> int:
    """Open a file for direct I/O where the file system supports it."""
    try:
        return os.open(file, flags | getattr(os, "O_DIRECT", 0), 0o666)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        return os.open(file, flags, 0o666)
