"""Signals that end what runs until somebody ends it: the first one asks it to stop, the second one ends the process."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def stopped_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP call a function; a second one ends the process as always."""
    before: dict[int, Any] = {}

    def end(number: int, frame: object) -> None:
        stop()
        restore_signals(before)

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        restore_signals(before)


def restore_signals(handlers: dict[int, Any]) -> None:
    """Set handlers as they were: signal -> handler."""
    for number, handler in handlers.items():
        signal.signal(number, handler)
