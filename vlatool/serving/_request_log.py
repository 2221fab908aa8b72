"""What is kept of requests: their latest times, and a file of JSON lines that is written beside the answers."""

from __future__ import annotations

import json
import threading
from collections import deque
from pathlib import Path
from queue import Full, Queue
from typing import Any

import numpy as np

from vlatool.errors import OutputError
from vlatool.serving._service import RequestRecord

MAX_TIMES = 10_000
MAX_WAITING = 10_000
"""Records that wait for the disk; later ones are counted and left out."""


class RequestLog:
    """Takes the records of requests.

    Args:
        path: File to which a line is added for each request; none when None.

    Raises:
        OutputError: when the file cannot be opened.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._times: deque[float] = deque(maxlen=MAX_TIMES)
        self.lost = 0
        """Records that are not in the file."""
        self._queue: Queue[RequestRecord | None] = Queue(MAX_WAITING)
        self._thread: threading.Thread | None = None
        if path is not None:
            try:
                self._file = path.open("a", encoding="utf-8")
            except OSError as error:
                raise OutputError(f"{path} cannot be written: {error.strerror}.", "name another file") from None
            self._thread = threading.Thread(target=self._write, name="vlatool-requests", daemon=True)
            self._thread.start()

    def __call__(self, record: RequestRecord) -> None:
        """Take a record; never waits."""
        if not record.error:
            self._times.append(record.answer_ms)
        if self._thread is None:
            return
        try:
            self._queue.put_nowait(record)
        except Full:
            self.lost += 1

    def times_ms(self) -> dict[str, float]:
        """Return percentiles of the latest times until an answer, in milliseconds; nothing without answers."""
        if not self._times:
            return {}
        p50, p99 = np.percentile(list(self._times), [50, 99])
        return {"p50": float(p50), "p99": float(p99)}

    def close(self) -> None:
        """Write what waits, and close the file."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None

    def _write(self) -> None:
        with self._file:
            while (record := self._queue.get()) is not None:
                self._write_line(record._asdict())

    def _write_line(self, record: dict[str, Any]) -> None:
        try:
            self._file.write(json.dumps(record) + "\n")
            self._file.flush()
        except (OSError, ValueError):
            self.lost += 1
