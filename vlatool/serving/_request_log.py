"""What is kept of requests: their latest times, and a file of JSON lines that is written beside the answers."""

from __future__ import annotations

import itertools
import json
from collections import deque
from pathlib import Path

import numpy as np

from vlatool.errors import OutputError
from vlatool.runtime.telemetry.writer import END_S, Telemetry
from vlatool.serving._service import RequestRecord

MAX_TIMES = 10_000
MAX_WAITING = 10_000
"""Records that wait for the disk; when there are more, the oldest are left out and counted."""


class RequestLog:
    """Takes the records of requests; the thread of a ``Telemetry`` writes them, so that no answer waits for the disk.

    Args:
        path: File to which a line is added for each request; none when None.
        waiting: Number of records that may wait for the disk.

    Raises:
        OutputError: when the file cannot be opened.
    """

    def __init__(self, path: Path | None = None, *, waiting: int = MAX_WAITING) -> None:
        self._times: deque[float] = deque(maxlen=MAX_TIMES)
        self._numbers = itertools.count()
        self._unwritten: int | None = None
        self._file = None if path is None else _Lines(path)
        self._telemetry = None if self._file is None else Telemetry(self._file, size=waiting)

    @property
    def lost_count(self) -> int:
        """Records that are not in the file; before ``close``, those of which it is known."""
        if self._telemetry is None or self._unwritten is not None:
            return self._unwritten or 0
        return self._telemetry.drop_count + self._telemetry.failure_count

    def __call__(self, record: RequestRecord) -> None:
        """Take a record; never waits."""
        if not record.error:
            self._times.append(record.answer_ms)
        if self._telemetry is not None and self._unwritten is None:
            next(self._numbers)  # one step of the interpreter: no two threads count the same
            self._telemetry.put(record)

    def times_ms(self) -> dict[str, float]:
        """Return percentiles of the latest times until an answer, in milliseconds; nothing without answers."""
        if not self._times:
            return {}
        p50, p99 = np.percentile(list(self._times), [50, 99])
        return {"p50": float(p50), "p99": float(p99)}

    def close(self, seconds: float = END_S) -> None:
        """Write what waits, and close the file; a disk that does not answer is waited for so many seconds."""
        if self._telemetry is not None and self._file is not None and self._unwritten is None:
            self._telemetry.close(seconds)
            self._unwritten = next(self._numbers) - self._file.written


class _Lines:
    """A sink that adds a line of JSON for each record to a file.

    Attributes:
        written: Lines that are in the file.

    Raises:
        OutputError: when the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror}.", "name another file") from None
        self.written = 0
        self._torn = False

    def __call__(self, record: RequestRecord) -> None:
        """Add a line; raises OSError when it does not fit, and the next one begins a new line."""
        line = (b"\n" if self._torn else b"") + json.dumps(record._asdict()).encode() + b"\n"
        size = self._file.write(line) or 0
        if size < len(line):
            self._torn = self._torn or size > 0
            raise OSError(f"{size} of {len(line)} bytes of a record were written")
        self._torn = False
        self.written += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()
