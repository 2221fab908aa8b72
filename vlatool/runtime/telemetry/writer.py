"""Threads that take records out of a ring and write them, so that a control step never waits for a file."""

from __future__ import annotations

import atexit
import threading
import time
import weakref
from typing import Any

from vlatool.errors import UsageError
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.telemetry.record import Sink
from vlatool.runtime.telemetry.ring import Reader, Ring

SIZE, PERIOD_S, END_S = 4096, 0.1, 2.0
BURST, REST, MOST_REST_S = 8, 9.0, 0.01
"""Records after which a thread rests; for how long, by the time that they took; and at most, in s: a sink may block."""
TURN_S = 0.05
"""Longest wait for another sink's turn: one that takes longer blocks, and the others go on beside it."""
_OPEN: weakref.WeakSet[Telemetry] = weakref.WeakSet()


class Telemetry:
    """Passes records to sinks, each in a thread of its own, which a control step never waits for.

    ``put`` stores a record in a ring and returns. A sink that blocks loses the oldest records, and they are counted;
    what it raises is counted, too, and neither reaches the robot or another sink. After a few records a thread rests
    nine times as long as those took: it takes a tenth of a core at most, and where a control step wants the same core,
    it waits for those few, not for all. The threads take turns, so that it does not wait for several of them.

    Args:
        sinks: Functions of a record, such as ``JsonLines`` and ``Prometheus``.
        size: Number of records that the ring holds.
        period_s: Time between two looks into the ring, in seconds.

    Raises:
        UsageError: when a sink cannot be called, or a number is out of its range.
    """

    def __init__(self, *sinks: Sink, size: int = SIZE, period_s: float = PERIOD_S) -> None:
        check_whole("size", size, 1, 10**7)
        check_positive("period_s", period_s, "a number of seconds")
        for sink in sinks:
            if not callable(sink):
                raise UsageError(
                    f"telemetry is {sink!r:.80}; allowed: a function of a record, or Telemetry(...).",
                    'pass records.append, or Telemetry(JsonLines("log.jsonl"))',
                )
        ring, turn = Ring(size), Turn(min(TURN_S, period_s / 2))
        self.put = ring.put
        self.outlets = tuple(Outlet(sink, Reader(ring), period_s, turn) for sink in sinks)
        """What takes the records of each sink."""
        _OPEN.add(self)
        weakref.finalize(self, _finish, self.outlets).atexit = False

    @property
    def drop_count(self) -> int:
        """Records that were overwritten before a sink took them."""
        return sum(outlet.reader.dropped for outlet in self.outlets)

    @property
    def failure_count(self) -> int:
        """Records that sinks did not take."""
        return sum(outlet.failed for outlet in self.outlets)

    def flush(self, seconds: float = END_S) -> bool:
        """Wait until all records that are in the ring now are written; returns whether they are after that time."""
        end = time.monotonic() + seconds
        written = [outlet.flush(max(0.0, end - time.monotonic())) for outlet in self.outlets]
        return all(written)

    def close(self, seconds: float = END_S) -> bool:
        """Write what is left and end the threads; one that is blocked is left alone after that time."""
        end = time.monotonic() + seconds
        _finish(self.outlets)
        ended = [outlet.join(max(0.0, end - time.monotonic())) for outlet in self.outlets]
        return all(ended)


class Turn:
    """Lets one thread work at a time, unless it blocks: then the others do not wait for it.

    Args:
        wait_s: Time after which a thread that has the turn counts as blocked, in seconds.
    """

    def __init__(self, wait_s: float) -> None:
        self._lock, self._wait_s, self._blocked = threading.Lock(), wait_s, False

    def take(self) -> bool:
        """Wait until no other thread has the turn; returns whether this one has it, and is to ``end`` it."""
        taken = self._lock.acquire(timeout=0 if self._blocked else self._wait_s)
        if not taken:
            self._blocked = True  # until that thread ends its turn
        return taken

    def end(self) -> None:
        """Let another thread have it."""
        self._blocked = False
        self._lock.release()


class Outlet:
    """The thread of one sink.

    Attributes:
        failed: Records that the sink did not take.
        error: The last reason; empty without one.
    """

    def __init__(self, sink: Sink, reader: Reader, period_s: float, turn: Turn) -> None:
        self.sink, self.reader, self.failed, self.error = sink, reader, 0, ""
        self._period_s, self._turn = period_s, turn
        self._wake, self._idle = threading.Event(), threading.Event()
        self._ends = self._hurries = False
        self._thread = threading.Thread(target=self._work, name="vlatool-telemetry", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._ends:
            self._wake.wait(self._period_s)
            self._wake.clear()
            self._write()
            self._idle.set()
        self._write()
        self._call("close")

    def _write(self) -> None:
        """Pass on all records that are there."""
        more = True
        while more:
            has_turn = not self._hurries and self._turn.take()
            begin = time.perf_counter()
            try:
                more = self._pass_on()
                if not more:
                    self._call("flush")
            finally:
                if has_turn:
                    self._turn.end()
            if more and not self._hurries:
                time.sleep(min(MOST_REST_S, REST * (time.perf_counter() - begin)))

    def _pass_on(self) -> bool:
        """Pass a few records on; returns whether there may be more."""
        for _ in range(BURST):
            if (record := self.reader.take()) is None:
                return False
            try:
                self.sink(record)
            except Exception as error:  # the seam: a full disk is no reason to stop the robot
                self._note(error)
            if not self._hurries:
                time.sleep(0)  # lets others go on
        return True

    def _call(self, method: str) -> None:
        try:
            getattr(self.sink, method, _nothing)()
        except Exception as error:  # as above
            self._note(error)

    def _note(self, error: Exception) -> None:
        self.failed += 1
        self.error = f"{type(error).__name__}: {error}"

    def flush(self, seconds: float) -> bool:
        """Wait until the thread has looked into the ring; see ``Telemetry.flush``."""
        if not self._thread.is_alive():
            return True
        self._hurries = True
        try:
            return self._look(seconds) and self._look(seconds)  # the first may have begun before
        finally:
            self._hurries = False

    def _look(self, seconds: float) -> bool:
        self._idle.clear()
        self._wake.set()
        return self._idle.wait(seconds)

    def finish(self) -> None:
        """Let the thread end after what is in the ring."""
        self._ends = self._hurries = True
        self._wake.set()

    def join(self, seconds: float) -> bool:
        """Wait until the thread has ended; returns whether it has."""
        self._thread.join(seconds)
        return not self._thread.is_alive()


def _nothing() -> Any:
    return None


def _finish(outlets: tuple[Outlet, ...]) -> None:
    for outlet in outlets:
        outlet.finish()


def _close_all() -> None:
    for telemetry in list(_OPEN):
        telemetry.close(END_S)


atexit.register(_close_all)
