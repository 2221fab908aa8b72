"""A fixed piece of work that shows whether the processor itself became slower or faster during a run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median

LOOP = 20_000
REPEATS = 5
MAX_DRIFT = 0.05
"""Share by which the middles of both halves may differ: more, and the run saw two machines."""


def canary_ms() -> float:
    """Return the milliseconds of the work, the fastest of a few: what the clock gives, not what neighbours take."""
    taken = []
    for _ in range(REPEATS):
        start = time.perf_counter_ns()
        sum(range(LOOP))
        taken.append((time.perf_counter_ns() - start) / 1e6)
    return min(taken)


def drift(canaries: Sequence[float]) -> float:
    """Return by which share the second half is slower than the first (negative: faster); 0 with fewer than four."""
    half = len(canaries) // 2
    if half < 2:
        return 0.0
    return median(canaries[-half:]) / median(canaries[:half]) - 1
