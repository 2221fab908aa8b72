"""How far each recorded sample is off, and how much worse one policy is than another on the same samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.spec import TensorSpec
from vlatool.statistics import paired_drop

Array = NDArray[Any]
DRAWS = 4000


def losses(action: TensorSpec, got: Array, wanted: Array) -> Array:
    """Return how far each sample is from what was wanted, (N,) float64.

    Discrete: the share of its actions that differ. Continuous: the mean over steps and elements of |difference|, each
    element divided by the standard deviation of what was wanted; elements that never change do not count.
    """
    count = len(got)
    if action.kind == "discrete":
        return np.asarray((got.reshape(count, -1) != wanted.reshape(count, -1)).mean(axis=1), np.float64)
    steps = min(got.shape[1], wanted.shape[1])
    got, wanted = got[:, :steps].astype(np.float64), wanted[:, :steps].astype(np.float64)
    spread = wanted.std(axis=(0, 1))
    varied = spread > 0
    if not varied.any():
        return np.asarray(np.abs(got - wanted).mean(axis=(1, 2)))
    return np.asarray((np.abs(got - wanted)[..., varied] / spread[varied]).mean(axis=(1, 2)))


def drop(
    candidate: Array, baseline: Array, episodes: Array | None, confidence: float, seed: int = 0
) -> tuple[float, float, float]:
    """Return how much more the candidate loses than the baseline on the same samples, with an interval.

    Samples of one episode are alike, so whole episodes are drawn again (cluster bootstrap, Davison and Hinkley 1997,
    3.8); where nothing differs but a few samples a bootstrap sees too little, so the interval is never narrower than
    that of as many independent right-or-wrong answers (Agresti and Min).

    Args:
        candidate, baseline: (N,) losses.
        episodes: (N,) episode of each sample; each sample is its own when None.
        confidence: Of the two-sided interval.
        seed: Of the draws.

    Returns:
        (drop, low, high); positive is worse.
    """
    difference = np.asarray(candidate, np.float64) - np.asarray(baseline, np.float64)
    groups = np.arange(len(difference)) if episodes is None else np.asarray(episodes)
    _, place = np.unique(groups, return_inverse=True)
    sums = np.bincount(place, difference)
    counts = np.bincount(place)
    random = np.random.default_rng(seed)
    means = np.empty(DRAWS)
    for draw in range(DRAWS):
        drawn = random.integers(len(sums), size=len(sums))
        means[draw] = sums[drawn].sum() / counts[drawn].sum()
    value = float(difference.mean())
    low, high = (float(np.quantile(means, part)) for part in ((1 - confidence) / 2, (1 + confidence) / 2))
    if set(np.unique(candidate)) | set(np.unique(baseline)) <= {0.0, 1.0}:
        lost, won = int((difference > 0).sum()), int((difference < 0).sum())
        _, least, most = paired_drop(lost, won, len(difference), confidence)
        low, high = min(low, least), max(high, most)
    return value, min(low, value), max(high, value)
