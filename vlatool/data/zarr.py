"""Zarr datasets of Diffusion Policy: ``data/KEY`` with all steps, ``meta/episode_ends``; a directory or a zip file."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.data._lazy_rows import LazyRows
from vlatool.data._pictures import library_errors
from vlatool.data._recording import Values
from vlatool.data._step_reader import StepReader
from vlatool.data._steps import Steps
from vlatool.errors import DataError, require
from vlatool.files.json import read_json
from vlatool.files.limits import check_limit, limit
from vlatool.registry import Claim

Array = NDArray[Any]
ZIP_SUFFIX = ".zarr.zip"
METADATA = (".zarray", "zarr.json", ".zgroup", ".zmetadata")
CODECS = frozenset({
    "blosc", "zstd", "zlib", "gzip", "lz4", "bz2", "lzma", "delta", "shuffle", "crc32", "crc32c", "adler32",
    "fletcher32", "vlen-utf8", "bytes", "transpose", "sharding_indexed", "fixedscaleoffset", "quantize", "packbits",
})  # fmt: skip
"""Codecs that are decoded: those that hold arrays. Pickle runs what is in a file."""
ENDS = "meta/episode_ends"
WRITE_AGAIN = "write the dataset again, or copy it again"


class Zarr(StepReader):
    """Reads what Diffusion Policy records: ``data/...`` and ``meta/episode_ends``."""

    suffix: ClassVar[str] = ".zarr"
    needs: ClassVar[str] = "a .zarr directory or .zarr.zip file with data/ and meta/episode_ends"

    @classmethod
    def claims(cls, path: Path) -> Claim:
        """Claim a directory that is a zarr group, and a zip file of that name."""
        if path.is_dir():
            return Claim.CERTAIN if any((path / name).is_file() for name in METADATA) else Claim.NONE
        return Claim.CERTAIN if path.name.endswith(ZIP_SUFFIX) else Claim.NONE

    def steps(self, path: Path) -> Steps:
        """Return what a dataset holds.

        Raises:
            DataError: when it is corrupt, lacks a chunk, or is coded by what could run code.
            MissingExtra: when zarr is not installed.
        """
        library = require("zarr", "data")
        with library_errors(str(path), WRITE_AGAIN):
            for name, metadata in _metadata(path):
                _check_codecs(f"'{name}' in {path}", metadata)
            store = library.storage.ZipStore(str(path), mode="r") if path.is_file() else str(path)
            group = library.open_group(store, mode="r")
            ends = _ends(path, group)
            columns = {name: _column(f"'{name}' in {path}", group[f"data/{name}"], ends) for name in _keys(path, group)}
        lengths = np.diff(ends, prepend=0)
        action = "action" if "action" in columns else ""
        return Steps(path, columns, np.repeat(np.arange(len(lengths)), lengths), action=action)


def _metadata(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the metadata of each array: its file and its content."""
    most = limit("manifest_bytes")
    if path.is_file():
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                if member.filename.rpartition("/")[2] in METADATA:
                    if member.file_size > most:
                        raise DataError(f"'{member.filename}' in {path} has {member.file_size} bytes.", WRITE_AGAIN)
                    yield member.filename, _json(archive.read(member), f"'{member.filename}' in {path}")
        return
    for file in sorted(file for name in METADATA for file in path.rglob(name)):
        with file.open("rb") as stream:
            yield file.relative_to(path).as_posix(), _json(stream.read(most), str(file))


def _json(content: bytes, where: str) -> Any:
    return read_json(content, where, DataError, WRITE_AGAIN)


def _check_codecs(where: str, metadata: Any) -> None:
    """Refuse codecs that are not known, wherever they are named."""
    for value in _mappings(metadata):
        codec = value.get("id") or (value.get("name") if "configuration" in value else None)
        if codec in ("regular", "default", "v2", None):  # grids and keys of chunks
            continue
        if codec not in CODECS and not str(codec).startswith("numcodecs."):
            raise DataError(f"{where} is coded by '{str(codec)[:40]}', which is not read.", "write it with Blosc")
    if json.dumps(metadata).find("pickle") >= 0:
        raise DataError(f"{where} holds pickled objects, which are refused.", "write it with Blosc")


def _mappings(value: Any) -> Iterator[Mapping[str, Any]]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if isinstance(value, dict):
        yield value
    for item in inner:
        yield from _mappings(item)


def _ends(path: Path, group: Any) -> Array:
    """Return the row behind the last of each episode."""
    if ENDS not in group:
        raise DataError(
            f"{path} has no {ENDS}.", "wanted: data/KEY for all steps, meta/episode_ends, as Diffusion Policy"
        )
    array = group[ENDS]
    _check_chunks(f"'{ENDS}' in {path}", array)
    ends = np.asarray(array[:])
    if ends.ndim != 1 or ends.dtype.kind not in "iu" or not len(ends) or (np.diff(ends, prepend=0) <= 0).any():
        raise DataError(
            f"'{ENDS}' in {path} must be rising whole numbers above 0; got {ends[:6].tolist()}.", WRITE_AGAIN
        )
    check_limit("recorded_steps", int(ends[-1]), str(path), DataError)
    return ends.astype(np.int64)


def _keys(path: Path, group: Any) -> list[str]:
    if "data" not in group or not hasattr(group["data"], "array_keys"):
        raise DataError(
            f"{path} has no data/.", "wanted: data/KEY for all steps, meta/episode_ends, as Diffusion Policy"
        )
    return sorted(group["data"].array_keys())


def _check_chunks(where: str, array: Any) -> None:
    """Refuse an array of which a chunk is missing: zarr gives zeros for it."""
    present, wanted = array.nchunks_initialized, array.nchunks
    if present < wanted:
        raise DataError(
            f"{where} has {present} of {wanted} chunks; the others are missing, not zero.",
            "copy the dataset again; where they are zero, write it again with write_empty_chunks=True",
        )


def _column(where: str, array: Any, ends: Array) -> Values:
    """Return a column: pictures read when they are asked for, all else in memory."""
    check_limit("picture_bytes", int(np.prod(array.shape[1:], dtype=object)) * array.dtype.itemsize, where, DataError)
    if not array.ndim or array.shape[0] != ends[-1]:
        raise DataError(f"{where} has the shape {list(array.shape)}; its episodes have {ends[-1]} steps.", WRITE_AGAIN)
    _check_chunks(where, array)
    if array.ndim < 3:
        values = np.asarray(array[:])
        return values.astype(str) if values.dtype.kind in "OT" else values
    return LazyRows(_Chunks(array, where).fetch, tuple(array.shape), np.dtype(array.dtype), where)


class _Chunks:
    """Reads rows of an array; the rows of the last chunk stay in memory."""

    def __init__(self, array: Any, where: str) -> None:
        self._array, self._where = array, where
        self._size = int(array.chunks[0])
        self._number = -1
        self._rows: Array = np.empty(0)

    def fetch(self, indices: NDArray[np.intp]) -> Array:
        """Return some rows."""
        values = np.empty((len(indices), *self._array.shape[1:]), self._array.dtype)
        for at, index in enumerate(indices):
            number = int(index) // self._size
            if number != self._number:
                with library_errors(f"chunk {number} of {self._where}", WRITE_AGAIN):
                    self._rows = np.asarray(self._array[number * self._size : (number + 1) * self._size])
                self._number = number
            values[at] = self._rows[int(index) - number * self._size]
        return values
