"""Intervals and paired tests, each exact or distribution-free."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the Wilson score interval of a share (Wilson 1927; Brown, Cai, DasGupta 2001).

    Raises:
        ValueError: unless 0 <= successes <= trials and trials > 0.

    Example:
        >>> tuple(round(bound, 3) for bound in wilson(98, 100))
        (0.93, 0.994)
    """
    if not 0 <= successes <= trials or not trials:
        raise ValueError(f"{successes} successes in {trials} trials")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    share = successes / trials
    centre = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def sign_test(many: int, trials: int) -> float:
    """Return the exact one-sided p-value of a sign test: the chance of at least so many heads of fair coins.

    Example:
        >>> sign_test(2, 2), sign_test(0, 0)
        (0.25, 1.0)
    """
    tail: float = sum(math.comb(trials, count) for count in range(many, trials + 1)) / 2**trials
    return tail


def mcnemar_exact(lost: int, won: int) -> float:
    """Return the two-sided exact p-value of McNemar's test: binomial with p = 1/2 over the discordant pairs.

    Args:
        lost: Pairs in which only the baseline succeeded.
        won: Pairs in which only the candidate succeeded.

    Example:
        >>> round(mcnemar_exact(5, 0), 4)
        0.0625
    """
    total, few = lost + won, min(lost, won)
    tail: float = sum(math.comb(total, count) for count in range(few + 1)) / 2**total
    return min(1.0, 2 * tail)


def paired_drop(lost: int, won: int, pairs: int, confidence: float = 0.95) -> tuple[float, float, float]:
    """Return the drop in success rate of paired episodes, with a score-type interval for small counts.

    The drop is ``(lost - won) / pairs``. The interval is Agresti and Min's (2005): one half is added to each cell of
    the 2x2 table before Wald's formula, which keeps the coverage near nominal with few discordant pairs.

    Returns:
        (drop, low, high), shares from -1 to 1; positive means worse than the baseline.
    """
    n = pairs + 2.0
    b, c = lost + 0.5, won + 0.5
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    centre = (b - c) / n
    spread = z * math.sqrt(max(b + c - (b - c) ** 2 / n, 0.0)) / n
    return (lost - won) / pairs, max(-1.0, centre - spread), min(1.0, centre + spread)


def quantile_interval(
    samples: Sequence[float] | NDArray[np.float64], quantile: float, confidence: float = 0.95
) -> tuple[float, float | None, float | None]:
    """Return a sample quantile with a distribution-free interval from order statistics.

    The ranks are those of the binomial distribution of the number of samples below the quantile (David and Nagaraja,
    Order Statistics, 7.1). A bound is None where the samples are too few for it.

    Raises:
        ValueError: when there are no samples.
    """
    ordered = np.sort(np.asarray(samples, np.float64))
    count = len(ordered)
    if not count:
        raise ValueError("no samples")
    value = float(ordered[min(count - 1, max(0, math.ceil(quantile * count) - 1))])
    tail = (1 - confidence) / 2
    below = binomial_tail(count, quantile)
    low_rank = int(np.searchsorted(below, tail, side="right")) - 1
    high_rank = int(np.searchsorted(below, 1 - tail, side="left")) + 1
    low = float(ordered[low_rank]) if low_rank >= 0 else None
    high = float(ordered[high_rank - 1]) if high_rank <= count else None
    return value, low, high


def student(share: float, freedom: int) -> float:
    """Return a quantile of Student's distribution.

    Args:
        share: Above 0 and below 1.
        freedom: Degrees of freedom, 1 or more.
    """
    from scipy.special import stdtrit  # a target, which has numpy alone, imports this module as well

    return float(stdtrit(freedom, share))


def binomial_tail(count: int, chance: float) -> NDArray[np.float64]:
    """Return the probabilities of at most 0, 1, ... ``count`` successes in ``count`` trials, (count + 1,).

    By logarithms, so that large counts do not underflow to nothing.
    """
    steps = np.log(np.arange(1, count + 1))
    logs = np.concatenate([[0.0], np.cumsum(steps)])  # of the factorials
    ranks = np.arange(count + 1)
    ways = logs[-1] - logs - logs[::-1]
    return np.asarray(np.cumsum(np.exp(ways + ranks * math.log(chance) + (count - ranks) * math.log1p(-chance))))
