"""The remaining time of a training."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

WARM = 3
"""Steps of this run before anything is said: the first ones take longer."""


class Forecast:
    """Tells from the steps and pauses of this run when it will end.

    Args:
        done: number of steps before this run.
        now: the clock, in seconds.
    """

    def __init__(self, steps: int, done: int, now: Callable[[], float] = time.monotonic) -> None:
        self._steps, self._now = steps, now
        self._first, self._start = done + WARM, now()
        self._paused: list[float] = []

    @contextlib.contextmanager
    def pause(self) -> Iterator[None]:
        """Note how long the block takes, in which no step is taken."""
        start = self._now()
        try:
            yield
        finally:
            self._paused.append(self._now() - start)

    def time_left(self, step: int) -> str:
        """Return in words how long it will take from a step on; nothing while that is not known."""
        if step <= self._first:
            self._start = self._now() - sum(self._paused)
            return ""
        taken = self._now() - self._start - sum(self._paused)
        seconds = taken / (step - self._first) * (self._steps - step)
        pauses = sum(self._paused) / (step - self._first) * (self._steps - step)  # as many as for the steps so far
        return f"{duration(seconds + pauses)} left"


def duration(seconds: float) -> str:
    """Return a time in words.

    Example:
        >>> duration(42.3), duration(725), duration(9000)
        ('42 s', '12 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
