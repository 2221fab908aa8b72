"""Error of each recorded sample, and the additional error of one policy over another on the same samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import TensorSpec
from vlatool.stats.bootstrap import resampled_sums
from vlatool.stats.intervals import paired_drop, student

Array = NDArray[Any]
DRAWS = 4000
ROUNDING = 1e-6
"""Share of the largest value below which a standard deviation is that of rounding."""
LEAST_SCALE = 0.1
"""Share of the largest standard deviation that every element is taken to vary by at least."""
CONSTANT_SHARE = 1e-3
"""Share of the largest standard deviation below which all elements of a unit hold still."""


def losses(action: TensorSpec, got: Array, wanted: Array) -> Array:
    """Return how far each sample is from what was wanted, (N,) float64.

    Discrete: the share of its actions that differ. Continuous: the mean over steps and elements of |difference|, each
    element divided by its scale in what was wanted (``scale_of``); not divided where nothing wanted ever changes.
    """
    if action.kind == "discrete":
        return np.asarray((~agreeing(got, wanted)).mean(axis=1), np.float64)
    steps = min(got.shape[1], wanted.shape[1])
    got, wanted = got[:, :steps].astype(np.float64), wanted[:, :steps].astype(np.float64)
    scale = scale_of(action, wanted)
    return np.asarray((np.abs(got - wanted) / np.where(scale > 0, scale, 1.0)).mean(axis=(1, 2)))


def scale_of(action: TensorSpec, wanted: Array) -> Array:
    """Return by what the difference of each element is divided, (A,); zeros where nothing wanted ever changes.

    It is the element's standard deviation, but no less than ``LEAST_SCALE`` of the largest among the elements of its
    unit, or among all elements where what that unit does is less than ``CONSTANT_SHARE`` of it. An element that is
    meant to hold still would else count for nothing, however far off it is, and one that jitters by a nanometre for
    everything.
    """
    spread = spread_of(wanted)
    units = action.units() if len(action.units()) == len(spread) else ("",) * len(spread)
    largest = {unit: max(value for value, own in zip(spread, units, strict=True) if own == unit) for unit in units}
    moving = {unit: value if value > CONSTANT_SHARE * spread.max() else spread.max() for unit, value in largest.items()}
    floors = np.asarray([LEAST_SCALE * moving[unit] for unit in units])
    return np.asarray(np.maximum(spread, floors), np.float64)


def agreeing(got: Array, wanted: Array) -> Array:
    """Return whether discrete actions are the same, (N, T) bool, for the leading steps that both have."""
    got, wanted = got.reshape(len(got), -1), wanted.reshape(len(wanted), -1)
    steps = min(got.shape[1], wanted.shape[1])
    return np.asarray(got[:, :steps] == wanted[:, :steps])


def spread_of(actions: Array) -> Array:
    """Return the standard deviation of each element of (N, T, A) actions, (A,); 0 where it is that of rounding."""
    wide = actions.astype(np.float64)
    spread = wide.std(axis=(0, 1))
    return np.where(spread > ROUNDING * np.abs(wide).max(axis=(0, 1)), spread, 0.0)


def drop(
    candidate: Array, baseline: Array, episodes: Array | None, confidence: float, answers: bool = False, seed: int = 0
) -> tuple[float, float, float]:
    """Return how much more the candidate loses than the baseline on the same samples, with an interval.

    Samples of one episode are alike, so the episode is the unit. The interval is the widest of three: whole episodes
    drawn again (cluster bootstrap, Davison and Hinkley 1997, 3.8), which is too narrow with few of them; Student's on
    the episodes' means, endless with one; and, where losses are shares of wrong answers, that of as many pairs of
    which some got worse and some better (Agresti and Min), for a bootstrap sees nothing in a few changes.

    Args:
        candidate, baseline: (N,) losses.
        episodes: (N,) episode of each sample; each sample is its own when None.
        confidence: coverage of the two-sided interval.
        answers: Whether losses are shares of wrong answers.

    Returns:
        (drop, low, high); positive is worse.
    """
    difference = np.asarray(candidate, np.float64) - np.asarray(baseline, np.float64)
    groups = np.arange(len(difference)) if episodes is None else np.asarray(episodes)
    _, index = np.unique(groups, return_inverse=True)
    sums, counts = np.bincount(index, difference), np.bincount(index)
    value = float(difference.mean())
    if not difference.any() and not answers:
        return value, 0.0, 0.0
    bounds = [_bootstrap(sums, counts, confidence, seed), _student(sums / counts, value, confidence)]
    if answers:
        lost, won = int((difference > 0).sum()), int((difference < 0).sum())
        bounds.append(paired_drop(lost, won, len(difference), confidence)[1:])
    return value, min(value, *(low for low, _ in bounds)), max(value, *(high for _, high in bounds))


def _bootstrap(sums: Array, counts: Array, confidence: float, seed: int) -> tuple[float, float]:
    drawn, size = resampled_sums((sums, counts.astype(np.float64)), DRAWS, np.random.default_rng(seed))
    low, high = np.quantile(drawn / size, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def _student(means: Array, value: float, confidence: float) -> tuple[float, float]:
    count = len(means)
    if count < 2:
        return -np.inf, np.inf
    half = student((1 + confidence) / 2, count - 1) * float(np.std(means, ddof=1)) / count**0.5
    return value - half, value + half
