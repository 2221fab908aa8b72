"""Journal of the finished records of a file, so that a killed run can be resumed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from vlatool.errors import SourceError
from vlatool.quantize.streamed.records import Record
from vlatool.weights.shards import Reader, StoredTensor

DATA, JOURNAL = "data", "journal"
READ_BYTES = 1 << 23


class Journal:
    """A JSON line for the plan, then one for each finished record.

    A line holds the figures of its record and the SHA-256 of the data up to its end, so that a record counts only when
    all records before it are intact, too.

    Args:
        plan: Identifier of everything that the bytes depend on.
    """

    def __init__(self, directory: Path, plan: str) -> None:
        self._path, self._data = directory / JOURNAL, directory / DATA
        self._head = (json.dumps({"plan": plan}) + "\n").encode()
        self._stream: Any = None

    def resume(self, records: list[Record]) -> tuple[Any, list[dict[str, Any]]]:
        """Return the running hash of the finished data and the figures of the finished records; truncate the rest."""
        lines = self._path.read_bytes().splitlines(keepends=True) if self._path.is_file() else []
        digest, offset, valid_bytes = hashlib.sha256(), 0, len(self._head)
        notes: list[dict[str, Any]] = []
        if not lines or lines[0] != self._head or not self._data.is_file():
            self._path.write_bytes(self._head)
            lines = []
        with Reader() as reader:
            for record, line in zip(records, lines[1:], strict=False):
                entry, advanced = _parse_entry(line), digest.copy()
                if entry is None or not _is_whole(reader, self._data, offset, record.size, advanced, entry["sha256"]):
                    break
                digest = advanced
                offset += record.size
                notes.append(entry["note"])
                valid_bytes += len(line)
        self._data.touch()
        os.truncate(self._data, offset)
        self._stream = self._path.open("r+b")
        self._stream.truncate(valid_bytes)
        self._stream.seek(valid_bytes)
        return digest, notes

    def add(self, note: dict[str, Any], sha256: str) -> None:
        """Add a record whose data is written: it survives a killed process, and a power cut after ``flush``."""
        self._stream.write((json.dumps({"sha256": sha256, "note": note}) + "\n").encode())
        self._stream.flush()

    def flush(self) -> None:
        """Flush data and journal to the disk, in this order."""
        handle = os.open(self._data, os.O_RDONLY)
        try:
            os.fdatasync(handle)
        finally:
            os.close(handle)
        os.fdatasync(self._stream.fileno())

    def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(OSError):
            self._stream.close()


def _parse_entry(line: bytes) -> dict[str, Any] | None:
    """Return the entry of a line, None when it is truncated."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    return entry if line.endswith(b"\n") and isinstance(entry, dict) and {"sha256", "note"} <= set(entry) else None


def _is_whole(reader: Reader, file: Path, offset: int, size: int, digest: Any, sha256: str) -> bool:
    try:
        hash_part(reader, file, offset, size, digest)
    except SourceError:  # the file is shorter
        return False
    return bool(digest.hexdigest() == sha256)


def hash_part(reader: Reader, file: Path, offset: int, size: int, digest: Any) -> None:
    """Update a hash with part of a file, read from the disk."""
    part = StoredTensor(file.name, file, offset, "U8", (size,))
    for begin in range(0, size, READ_BYTES):
        digest.update(reader.read(part, begin, min(READ_BYTES, size - begin)).data)
