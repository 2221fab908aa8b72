"""Sample all readers during a run, in a separate thread."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType

from vlatool.telemetry._reading import Absent, Reader
from vlatool.telemetry._summary import Series, Summary, summarise

STOP_TIMEOUT_S = 10.0
"""A read takes at most a few commands of two seconds each; after this time the thread is abandoned."""


class Recorder:
    """Samples readers at the start, every ``period_s`` seconds, and at the end.

    The thread is a daemon and takes about as much of one core as reading the files. A reader that starts a process is
    read at most once in its own ``period_s``. A reader that fails is dropped and listed among the absent.

    Args:
        readers: Readers, and absent ones, from ``open_all``.
        clock: Clock of monotonic seconds.

    Raises:
        ValueError: when ``period_s`` is not above zero.

    Example:
        >>> with Recorder([]) as recorder:
        ...     pass
        >>> recorder.recorded.throttled is None
        True
    """

    def __init__(
        self, readers: Iterable[Reader | Absent], period_s: float = 0.1, clock: Callable[[], float] = time.monotonic
    ) -> None:
        if not (math.isfinite(period_s) and period_s > 0):
            raise ValueError(f"period_s must be above zero, got {period_s}")
        opened = list(readers)
        self._absent = [absent for absent in opened if isinstance(absent, Absent)]
        self._readers = [reader for reader in opened if isinstance(reader, Reader)]
        self._period_s = period_s
        self._clock = clock
        self._last: dict[str, float] = {}
        self._samples: dict[str, Series] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Recorder:
        self.sample(every=True)
        self._stop.clear()
        self._thread = threading.Thread(target=self._loop, name="telemetry", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(STOP_TIMEOUT_S)
            if self._thread.is_alive():
                self._absent.append(Absent("recorder", "a reader did not return, so the last samples are missing"))
            else:
                self.sample(every=True)
            self._thread = None

    def sample(self, every: bool = False) -> None:
        """Read all readers that are due; with ``every`` all of them."""
        for reader in [*self._readers]:
            now = self._clock()
            if every or now - self._last.get(reader.name, -math.inf) >= reader.period_s:
                self._last[reader.name] = now
                self._read(reader, now)

    @property
    def summary(self) -> Summary:
        """Summary of the samples so far."""
        with self._lock:
            partly = [part for reader in self._readers for part in reader.absent()]
            return summarise(self._samples, [*self._absent, *partly])

    def _loop(self) -> None:
        while not self._stop.wait(self._period_s):
            self.sample()

    def _read(self, reader: Reader, now: float) -> None:
        try:
            readings = reader.read()
        except Exception as error:  # a reader must never end a measurement
            self._readers.remove(reader)
            self._absent.append(Absent(reader.name, f"the reader failed during the run: {error!r}"))
            return
        with self._lock:
            for reading in readings:
                self._samples.setdefault(reading.name, Series(reading)).append(now, reading)
