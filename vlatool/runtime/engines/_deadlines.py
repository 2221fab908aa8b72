"""Calls that are stopped at a deadline, by one thread that watches all of them.

A thread for each call takes longer than an inference of a small policy.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator


class Watchdog:
    """A thread that stops the calls in progress at their deadlines.

    It sleeps until the first deadline that it knows of, though that call may have ended: one with a later deadline need
    not wake it. It ends when it wakes and nothing is in progress.
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        """Begin without calls and thread, as in a child that was forked."""
        self._changed = threading.Condition()
        self._calls: dict[object, tuple[float, Callable[[], None]]] = {}
        self._wakes: float | None = None

    @contextlib.contextmanager
    def stopping(self, deadline: float, stop: Callable[[], None]) -> Iterator[None]:
        """Call ``stop`` once, from the thread, where the block is still in progress at the deadline.

        Args:
            deadline: seconds of ``time.monotonic``.
            stop: function that returns at once.
        """
        call = object()
        with self._changed:
            if self._wakes is None:
                threading.Thread(target=self._watch, name="deadlines", daemon=True).start()
                self._wakes = deadline  # not before: where no thread can be started, the next call tries again
            elif deadline < self._wakes:
                self._changed.notify()
            self._calls[call] = deadline, stop
        try:
            yield
        finally:
            with self._changed:
                self._calls.pop(call, None)

    def _watch(self) -> None:
        with self._changed:
            while self._calls:
                self._stop_overdue()
                if self._calls:
                    self._wakes = min(deadline for deadline, _ in self._calls.values())
                    self._changed.wait(min(self._wakes - time.monotonic(), threading.TIMEOUT_MAX))
            self._wakes = None

    def _stop_overdue(self) -> None:
        now = time.monotonic()
        for call, (deadline, stop) in list(self._calls.items()):
            if deadline <= now:
                del self._calls[call]
                stop()


WATCHDOG = Watchdog()
os.register_at_fork(after_in_child=WATCHDOG._reset)
