"""All metrics of an episode, and the ratio of two policies' means with its interval."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from vlatool import registry
from vlatool.motion.metric import Metric
from vlatool.motion.track import Track
from vlatool.stats.bootstrap import resampled_sums

KIND = "motion"
RESAMPLES = 2000
CONFIDENCE = 0.95
MIN_PAIRS = 8
"""Pairs below which a ratio has no interval."""


@cache
def metrics() -> dict[str, Metric]:
    """Return name -> metric, of vlatool and of other packages, by name."""
    return {name: registry.load(KIND, name)() for name in registry.names(KIND)}


def measure_episode(track: Track) -> dict[str, float]:
    """Return name -> number of one episode; what the track does not have, or is not finite, is left out."""
    values = {name: metric.of(track) for name, metric in metrics().items()}
    return {name: float(value) for name, value in values.items() if value is not None and math.isfinite(value)}


def ratio_of(
    own: NDArray[np.float64], base: NDArray[np.float64], confidence: float = CONFIDENCE
) -> tuple[float, float, float] | None:
    """Return the ratio of the means of paired episodes, and its interval.

    The interval is the basic percentile bootstrap of pairs (Efron and Tibshirani 1993, 13.3), with a fixed seed.

    Args:
        own: (N,) of the variant.
        base: (N,) of what it is held against, in the same episodes.
        confidence: Coverage of the interval.

    Returns:
        Ratio, low, high; the ends are infinite apart for fewer than ``MIN_PAIRS`` pairs. 1 where both are 0 throughout;
        None where there is no pair, or the mean that divides is 0.
    """
    if not len(base):
        return None
    if not own.any() and not base.any():
        return 1.0, 1.0, 1.0
    if (mean := float(base.mean())) <= 0:
        return None
    value = float(own.mean()) / mean
    if len(base) < MIN_PAIRS:
        return value, 0.0, float("inf")
    over, under = resampled_sums((own, base), RESAMPLES, np.random.default_rng(len(base)))
    ratios = np.divide(over, under, out=np.full(RESAMPLES, np.inf), where=under > 0)
    low, high = np.quantile(ratios, [(1 - confidence) / 2, (1 + confidence) / 2], method="nearest")
    return value, float(low), float(high)
