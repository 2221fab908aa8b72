"""Episodes that begin alike: three hundred that begin in three ways say hardly more than three do.

A start is a cluster. What as many episodes of each start are worth is Kish's effective size (Survey Sampling, 1965):
``(sum m)^2 / sum m^2`` for ``m`` episodes of each start, so many independent ones as are equally precise if all
episodes of a start end alike, as they do where neither environment nor policy draws anything else. Counts are reduced
to that size; a part of an episode that is left counts against whoever it may favour.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Sequence

from vlatool.stats.intervals import wilson

MIN_DISTINCT_STARTS = 8
"""Distinct starts below which episodes that repeat them decide nothing."""
Counts = tuple[int, int, int]
"""Lost, won, pairs."""


def distinct_starts(starts: Sequence[Hashable]) -> int:
    """Return how many starts there are."""
    return len(set(starts))


def has_too_few_starts(starts: Sequence[Hashable]) -> bool:
    """Return whether episodes repeat their starts, and have too few of them to decide anything."""
    return distinct_starts(starts) < min(MIN_DISTINCT_STARTS, len(starts))


def independent_starts(starts: Sequence[Hashable]) -> int:
    """Return the effective number of episodes, from 1; that of the episodes where no start is repeated.

    Example:
        >>> independent("abc" * 100), independent("abcdef"), independent("aaaaaaaab")
        (3, 6, 1)
    """
    return max(1, math.floor(len(starts) ** 2 / sum(times**2 for times in Counter(starts).values())))


def reduce_counts(lost: int, won: int, pairs: int, size: int) -> tuple[Counts, Counts]:
    """Return the counts of ``pairs`` pairs as those of ``size``: with the least drop, and with the largest.

    Args:
        lost, won, pairs: Observed counts.
        size: Independent pairs that they are worth, at most ``pairs``.

    Example:
        >>> reduced(10, 0, 300, 3)
        ((0, 0, 3), (1, 0, 3))
    """
    ends = [(math.floor(count * size / pairs), math.ceil(count * size / pairs)) for count in (lost, won)]
    (few_lost, many_lost), (few_won, many_won) = ends
    return (few_lost, min(many_won, size - few_lost), size), (min(many_lost, size - few_won), few_won, size)


def wilson_of(wins: int, starts: Sequence[Hashable]) -> tuple[float, float]:
    """Return the Wilson interval of a share of episodes, as wide as that of so many independent ones.

    Args:
        wins: Episodes that succeed.
        starts: Start of each episode; as many as there are episodes, from 1.
    """
    size = independent_starts(starts)
    share = wins * size / len(starts)
    return wilson(math.floor(share), size)[0], wilson(math.ceil(share), size)[1]
