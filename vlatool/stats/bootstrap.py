"""Sums of units that are drawn again: what a bootstrap of means, and of ratios of means, rests on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLOCK = 1 << 18
"""Units that are drawn at a time, over all resamples: it bounds the memory, and changes no number."""


def resampled_sums(
    columns: tuple[NDArray[np.float64], ...], resamples: int, random: np.random.Generator
) -> tuple[NDArray[np.float64], ...]:
    """Return the sum of each column over units drawn with replacement, as many as there are (Efron 1979).

    Args:
        columns: (N,) each, one value for each unit; N > 0.
        resamples: number of resamples R.
        random: what draws.

    Returns:
        (R,) for each column, of the same draws.
    """
    units = len(columns[0])
    rows = max(1, BLOCK // units)
    sums = tuple(np.empty(resamples) for _ in columns)
    for first in range(0, resamples, rows):
        drawn = random.integers(units, size=(min(rows, resamples - first), units))
        for total, column in zip(sums, columns, strict=True):
            total[first : first + rows] = column[drawn].sum(axis=1)
    return sums
