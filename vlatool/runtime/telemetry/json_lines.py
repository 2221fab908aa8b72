"""Records as lines of JSON, in files of a bounded size, each line with a checksum that covers those before it."""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import DataError, VlatoolError
from vlatool.files.json import parse_json
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.telemetry.health import Health
from vlatool.runtime.telemetry.record import PARTS, Delivery, TickRecord

MAX_BYTES, FILES, LONGEST = 10_000_000, 5, 1_000_000
MARK = ',"crc":"'
_encode = json.JSONEncoder(separators=(",", ":"), default=str, allow_nan=False).encode
"""What ``json.dumps`` would build again for each record."""


class JsonLines:
    """A sink that writes one line of JSON for each record.

    Lines are written when the records that were waiting are all there, without flushing the disk: a process that is
    killed loses what it has not written (a tenth of a second), a power cut what the system holds. A new run
    goes on in a new file; the oldest one goes.

    Args:
        path: The newest file; older ones have ``.1``, ``.2``, ... behind the name.
        max_bytes: Size of a file, which no line goes beyond.
        files: Number of files.
        health: Whose levels are written, too, when one changes.

    Raises:
        UsageError: when a number is out of its range.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        max_bytes: int = MAX_BYTES,
        files: int = FILES,
        health: Health | None = None,
    ) -> None:
        check_whole("max_bytes", max_bytes, 1000)
        check_whole("files", files, 1, 1000)
        self.path, self._max_bytes, self._files = Path(path), max_bytes, files
        self._health = health
        self._levels: dict[str, str] = {}
        self._handle: int | None = None
        self._lines: list[bytes] = []
        self._size = self._crc = 0

    def __call__(self, record: Any) -> None:
        """Take a record; it is written with the next ``flush``, or where those that wait fill a file."""
        self._add(as_dict(record))

    def _add(self, values: dict[str, Any]) -> None:
        line, crc = _line(values, self._crc)
        if self._size + len(line) > self._max_bytes:
            self._rotate()
            line, crc = _line(values, self._crc)
        self._crc = crc
        self._size += len(line)
        self._lines.append(line)

    def flush(self) -> None:
        """Write what waits; raises OSError where that is not possible, and what waited is lost."""
        self._note_health()
        self._write()

    def _write(self) -> None:
        if not self._lines:
            return
        content, self._lines = b"".join(self._lines), []
        try:
            if self._handle is None:
                self._open()
            rest = memoryview(content)
            while rest:
                rest = rest[os.write(self._handle, rest) :]  # type: ignore[arg-type]
        except OSError:
            self._begin_anew()  # what was written of a line ends the file for a reader
            raise

    def _note_health(self) -> None:
        if self._health is None:
            return
        levels = self._health.levels()
        now = {name: level.name.lower() for name, (level, _) in levels.items()}
        if now != self._levels:
            self._levels = now
            self._add({"health": now, "reasons": {name: reason for name, (_, reason) in levels.items() if reason}})

    def _open(self) -> None:
        """Begin the newest file, and move older ones by one."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for number in range(self._files - 1, 0, -1):
            older = self._name(number - 1)
            if older.exists():
                os.replace(older, self._name(number))
        self._handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)

    def _name(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}") if number else self.path

    def _rotate(self) -> None:
        self._write()
        self._begin_anew()

    def _begin_anew(self) -> None:
        if self._handle is not None:
            os.close(self._handle)
        self._handle, self._size, self._crc = None, 0, 0

    def close(self) -> None:
        """Write what waits and close the file."""
        try:
            self.flush()
        finally:
            self._begin_anew()


def as_dict(record: Any) -> dict[str, Any]:
    """Return a record as plain values: an action as a list, whatever is not known as text."""
    if isinstance(record, Delivery):
        return {"step": record.step, "transport_ms": round(record.transport_ms, 4)}
    if not isinstance(record, TickRecord):
        return {"event": str(record)}
    values = {"step": record.step, "started": round(record.started, 6)}
    values |= {name: round(getattr(record, name), 4) for name in ("waited_ms", "answer_ms")}
    if record.sensed_ms is not None:
        values["sensed_ms"] = round(record.sensed_ms, 4)
    parts = {f"{name}_ms": round(time, 4) for name, time in zip(PARTS, record.parts_ms, strict=True)}
    origin = record.origin
    if origin.latent_age_ms is not None:
        parts["latent_age_ms"] = round(origin.latent_age_ms, 4)
    return {
        **values, **parts, "missed": record.missed, "rung": record.rung, "level": record.level,
        "source": origin.source, "age_ms": None if origin.age_ms is None else round(origin.age_ms, 4),
        "checks": list(origin.checks), "alarms": list(record.alarms), "error": record.error,
        "action": None if record.action is None else _finite(np.asarray(record.action).tolist()),
    }  # fmt: skip


def _finite(values: Any) -> Any:
    """Return numbers, and None for each that JSON does not know."""
    if isinstance(values, list):
        return [_finite(value) for value in values]
    return values if math.isfinite(values) else None


def _line(values: dict[str, Any], crc: int) -> tuple[bytes, int]:
    """Return the line of some values, and the checksum of all lines so far."""
    body = _encode(values)[:-1].encode()
    crc = zlib.crc32(body, crc)
    return body + f'{MARK}{crc:08x}"}}\n'.encode(), crc


def read_lines(path: str | os.PathLike[str]) -> Iterator[dict[str, Any]]:
    """Return the records of a file, up to a last line that was not written to its end.

    Raises:
        DataError: at the first line that is not as it was written, or is not there, or when there is no file.
    """
    crc, number = 0, 0
    try:
        with Path(path).open("rb") as file:
            while line := file.readline(LONGEST + 1):
                number += 1
                if not line.endswith(b"\n"):
                    if len(line) > LONGEST or file.read(1):
                        raise _damaged(path, number)
                    return
                values, crc = _checked(line, crc, path, number)
                yield values
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.", "check the path") from None


def _checked(line: bytes, crc: int, path: Any, number: int) -> tuple[dict[str, Any], int]:
    body, mark, rest = line.rpartition(MARK.encode())
    crc = zlib.crc32(body, crc)
    if not mark or rest != f'{crc:08x}"}}\n'.encode():
        raise _damaged(path, number)
    try:
        values = parse_json(body + b"}")
    except (ValueError, VlatoolError):
        raise _damaged(path, number) from None
    if not isinstance(values, dict):
        raise _damaged(path, number)
    return values, crc


def _damaged(path: Any, number: int) -> DataError:
    return DataError(f"{path}: line {number} is not as it was written.", "use the lines before it")
