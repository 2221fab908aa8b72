"""Statistics of latencies: percentiles with bounds that hold without a distribution, and how much a series is worth.

A percentile is reported as MLPerf's loadgen does it (early stopping, tolerance 0): of n independent calls t exceed L;
"a share p of all calls takes at most L" is claimed with confidence c when a share below p would have shown more than t
with probability c (mlcommons/inference, loadgen/early_stopping.cc). The bound is an order statistic, so nothing is
assumed of the shape of the distribution. Calls in one process follow each other; the bound is made for as many
independent calls as the series is worth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlatool.stats.intervals import binomial_tail

Array = NDArray[np.float64]
PERCENTILES = (50.0, 90.0, 95.0, 99.0, 99.9)
CONFIDENCE = 0.99
CHANCE = 1.64
"""Standard errors of a correlation, 1 / sqrt(n), up to which it is taken for none: one in twenty exceeds them."""


@dataclass(frozen=True)
class Percentile:
    """A percentile of a series of latencies.

    Args:
        percent: 0-100.
        value: The order statistic; NaN when the series is too short to say anything of this percentile.
        bound: Upper bound of the percentile of all calls, at ``confidence``; NaN as above.
        needed: Independent calls from which there is a bound.
        effective_sample_size: Independent calls that the series is worth.
    """

    percent: float
    value: float
    bound: float
    needed: int
    effective_sample_size: float
    confidence: float = CONFIDENCE

    @property
    def known(self) -> bool:
        """Whether there are calls enough."""
        return math.isfinite(self.bound)

    @property
    def name(self) -> str:
        """``p50``, ``p99.9``."""
        return f"p{self.percent:g}"


def percentile(
    samples: Sequence[float] | Array,
    percent: float,
    confidence: float = CONFIDENCE,
    processes: Sequence[int] | None = None,
    most: float = math.inf,
) -> Percentile:
    """Return a percentile with its upper confidence bound, from dependent calls.

    Args:
        samples: Samples in the order in which they were taken, any unit.
        processes: Which process each call was made in; all in one when None.
        percent: Above 0 and below 100.
        confidence: One-sided confidence of the bound.
        most: Independent calls that the series is worth at most, where something else than the order tells.

    Raises:
        ValueError: when there is no sample, one is not finite, or the percentage is invalid.

    Example:
        >>> percentile([1.0] * 64, 90).known, percentile([1.0] * 40, 90).known
        (True, False)
    """
    if not 0 < percent < 100:
        raise ValueError(f"the percentage is {percent}; allowed: above 0 and below 100")
    series = np.asarray(samples, np.float64)
    if not len(series) or not np.isfinite(series).all():
        raise ValueError("no sample, or one that is not finite")
    share = percent / 100
    size = min(most, effective_sample_size(series, share, processes))
    needed = floor(share, confidence)
    if size < needed:
        return Percentile(percent, math.nan, math.nan, needed, size, confidence)
    ordered = np.sort(series)
    count = len(ordered)
    allowed = required_exceedances(int(size), share, confidence) / int(size)  # of the calls, beyond the bound
    value = ordered[min(count - 1, max(0, math.ceil(share * count) - 1))]
    bound = ordered[min(count - 1, count - 1 - math.floor(allowed * count))]
    return Percentile(percent, float(value), float(max(bound, value)), needed, size, confidence)


def proven_above(
    samples: Sequence[float] | Array,
    percent: float,
    limit: float,
    confidence: float = CONFIDENCE,
    processes: Sequence[int] | None = None,
) -> bool:
    """Return whether a percentile of all calls is above a limit, with confidence: too many of these calls were.

    Example:
        >>> proven_above([9.0] * 5 + [1.0] * 60, 99, 5.0), proven_above([9.0] * 1 + [1.0] * 60, 99, 5.0)
        (True, False)
    """
    series = np.asarray(samples, np.float64)
    size = int(effective_sample_size(series, percent / 100, processes))
    over = math.floor(float((series > limit).mean()) * size)
    if not over:
        return False
    fewer = binomial_tail(size, 1 - percent / 100)[over - 1]
    return bool(1 - fewer <= 1 - confidence)


def required_exceedances(count: int, share: float, confidence: float = CONFIDENCE) -> int:
    """Return how many of ``count`` calls may exceed the bound of a percentile; -1 when none of them is enough.

    The largest t with P(at most t of n exceed) <= 1 - confidence, where each exceeds with chance ``1 - share``.
    """
    return int(np.searchsorted(binomial_tail(count, 1 - share), 1 - confidence, side="right")) - 1


def floor(share: float, confidence: float = CONFIDENCE) -> int:
    """Return the smallest number of independent calls with a bound that one of them may exceed.

    One, and not none: a single stall would otherwise decide (the floors of loadgen, 64 for p90 and 662 for p99).
    """
    low, high = 1, 1
    while required_exceedances(high, share, confidence) < 1:
        low, high = high, high * 2
    while low + 1 < high:
        middle = (low + high) // 2
        low, high = (low, middle) if required_exceedances(middle, share, confidence) >= 1 else (middle, high)
    return high


def effective_calls(series: Array) -> float:
    """Return how many independent calls a series is worth: n (1 - r) / (1 + r), r the lag-1 correlation of the ranks.

    That is exact for a first-order autoregression; ranks keep one long stall from hiding what the others do. A series
    that alternates counts as independent.
    """
    count = len(series)
    if count < 3:
        return float(count)
    ranks = mean_ranks(series)
    centred = ranks - ranks.mean()
    spread = float(centred @ centred)
    if spread == 0:
        return float(count)
    follow = float(centred[1:] @ centred[:-1]) / spread
    if follow < CHANCE / math.sqrt(count):  # as independent calls give it, too
        return float(count)
    return count * (1 - follow) / (1 + follow)


def mean_ranks(series: Array) -> Array:
    """Return the rank of each value, from 1; equal values share the mean of theirs.

    Example:
        >>> mean_ranks(np.array([7.0, 3.0, 7.0])).tolist()
        [2.5, 1.0, 2.5]
    """
    _, index, counts = np.unique(series, return_inverse=True, return_counts=True)
    ranks: Array = (np.cumsum(counts) - (counts - 1) / 2)[index]
    return ranks


def effective_sample_size(series: Array, share: float, processes: Sequence[int] | None) -> float:
    """Return how many independent calls a series of several processes is worth, for a percentile.

    The smaller of two: by how calls follow each other, and by how far whole processes are apart, which a call's
    neighbours do not show (Kish's design effect 1 + (m - 1) rho; rho by one-way analysis of variance of which calls
    exceed the percentile).
    """
    worth = effective_calls(series)
    if processes is None or len(set(processes)) < 2:
        return worth
    exceeds = (series > np.quantile(series, share)).astype(np.float64)
    alike = max(0.0, intraclass(exceeds, processes))
    size = len(series) / len(set(processes))
    return min(worth, len(series) / (1 + (size - 1) * alike))


def intraclass(values: Array, processes: Sequence[int]) -> float:
    """Return the intraclass correlation: which share of the variance lies between processes (Fisher 1925)."""
    _, group, counts = np.unique(np.asarray(processes), return_inverse=True, return_counts=True)
    groups, total = len(counts), len(values)
    means = np.bincount(group, values) / counts
    within = float(((values - means[group]) ** 2).sum()) / max(1, total - groups)
    between = float((counts * (means - values.mean()) ** 2).sum()) / (groups - 1)
    size = (total - float((counts**2).sum()) / total) / (groups - 1)
    spread = between + (size - 1) * within
    return (between - within) / spread if spread > 0 else 0.0
