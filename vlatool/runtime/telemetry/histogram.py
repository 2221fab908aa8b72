"""Counts of times in bins whose edges grow by a constant factor, so that quantiles need no samples."""

from __future__ import annotations

import math
from math import ceil, log2

LOWEST_MS, PER_OCTAVE, OCTAVES = 0.001, 8, 27
"""From 1 us to 134 s; a quantile is within 2^(1/16), 4.5 %."""


class Histogram:
    """Counts of times.

    Attributes:
        count: Number of times.
        sum_ms: Their sum.
        max_ms: The largest.
    """

    def __init__(self) -> None:
        self._bins = [0] * (PER_OCTAVE * OCTAVES + 1)
        self.count, self.sum_ms, self.max_ms = 0, 0.0, 0.0

    def add(self, time_ms: float) -> None:
        """Count a time; what is not a number is left out, below 0 counts as 0."""
        if time_ms != time_ms:
            return
        self.count += 1
        if time_ms > 0:
            self.sum_ms += time_ms
        if time_ms > self.max_ms:
            self.max_ms = time_ms
        if time_ms <= LOWEST_MS:
            self._bins[0] += 1
            return
        octaves = log2(time_ms / LOWEST_MS)
        self._bins[ceil(octaves * PER_OCTAVE) if octaves < OCTAVES else -1] += 1

    def quantile_ms(self, share: float) -> float:
        """Return the time below which a share of the times lies, from 0 to 1; NaN without times."""
        if not self.count:
            return math.nan
        wanted, seen = share * self.count, 0
        for index, number in enumerate(self._bins):
            seen += number
            if number and seen >= wanted:
                return min(self.max_ms, LOWEST_MS * 2 ** ((index - 0.5) / PER_OCTAVE))
        return self.max_ms

    def cumulative(self) -> list[tuple[float, int]]:
        """Return (upper edge in ms, number of times up to it) for each octave."""
        found, seen = [], 0
        for index, number in enumerate(self._bins):
            seen += number
            if index % PER_OCTAVE == 0:
                found.append((LOWEST_MS * 2 ** (index / PER_OCTAVE), seen))
        return found
