"""How much slower B is than A, from a few pairs: Hodges-Lehmann estimate and exact bounds of the signed-rank test.

Each pair gives a difference d (of logarithms: a log ratio). The estimate is the median of the Walsh averages
(d_i + d_j) / 2, i <= j; a bound is one of these averages, which one follows from the exact null distribution of
Wilcoxon's signed-rank statistic (Hollander, Wolfe, Chicken, Nonparametric Statistical Methods, 3rd edition, 3.2-3.3).
Nothing is assumed of the distribution but that it is symmetric about its centre; pairs must be independent.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def walsh(differences: Sequence[float] | Array) -> Array:
    """Return the averages of all pairs, each value with itself too, in ascending order.

    Raises:
        ValueError: when there is no difference, or one is not finite.
    """
    values = np.asarray(differences, np.float64)
    if not len(values) or not np.isfinite(values).all():
        raise ValueError("no difference, or one that is not finite")
    first, second = np.triu_indices(len(values))
    return np.asarray(np.sort((values[first] + values[second]) / 2))


def hodges_lehmann(differences: Sequence[float] | Array) -> float:
    """Return the centre of the differences.

    Example:
        >>> hodges_lehmann([1.0, 2.0, 90.0])
        16.0
    """
    return float(np.median(walsh(differences)))


def lower_bound(differences: Sequence[float] | Array, alpha: float) -> float:
    """Return what the centre exceeds with confidence ``1 - alpha``, one-sided; minus infinity with too few pairs."""
    averages = walsh(differences)
    rank = _rank(len(differences), alpha)
    return float(averages[rank - 1]) if rank else -math.inf


def upper_bound(differences: Sequence[float] | Array, alpha: float) -> float:
    """Return what the centre stays below with confidence ``1 - alpha``, one-sided; infinity with too few pairs."""
    return -lower_bound(-np.asarray(differences, np.float64), alpha)


def min_differences(alpha: float) -> int:
    """Return the smallest number of pairs with a bound: 2^-n <= alpha; raises ValueError unless 0 < alpha < 1."""
    if not 0 < alpha < 1:
        raise ValueError(f"alpha is {alpha}; allowed: above 0 and below 1")
    count = max(1, math.ceil(-math.log2(alpha)))
    return count if Fraction(1, 2**count) <= Fraction(alpha) else count + 1


@functools.lru_cache(maxsize=64)
def _rank(count: int, alpha: float) -> int:
    """Return which Walsh average, from 1, is the lower bound; 0 when there is none."""
    ways = [1]
    for rank in range(1, count + 1):  # sums of subsets of 1..n: each rank is positive or not
        longer = ways + [0] * rank
        for index, number in enumerate(ways):
            longer[index + rank] += number
        ways = longer
    allowed, total = Fraction(alpha) * 2**count, 0
    for index, number in enumerate(ways):
        total += number
        if total > allowed:
            return index
    return len(ways)
