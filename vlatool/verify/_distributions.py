"""Explanations of a log of other episodes than the reference: by means and spreads alone, so only gross ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.statistics import Normaliser
from vlatool.verify._explanation import Explanation
from vlatool.verify._vectors import FACTORS

Array = NDArray[np.float64]
Moments = tuple[Array, Array]
"""Mean and standard deviation of each element."""
MAX_DEVIATIONS, MAX_RATIO = 4.0, 6.0
"""Deviations of a mean, and ratio of a spread, that other episodes do not explain."""
FIT_DEVIATIONS, FIT_RATIO = 2.0, 3.0
"""The same, up to which an explanation fits."""
WRONG, WRONG_RATIO, MIN_ROWS = 1.5, 4.0, 64
"""Deviations and ratio by which statistics are not those of a whole training recording, of so many rows."""
REMEDY = "name the statistics that the policy was trained with in its spec"


def moments(values: Array) -> Moments:
    """Return mean and standard deviation of each element of (N, A)."""
    return values.mean(axis=0), values.std(axis=0)


def explain_moments(
    name: str, labels: Sequence[str], log: Array, reference: Array, normaliser: Normaliser | None
) -> Explanation | None:
    """Return the change of a whole signal, or of one element, that gives the log's means and spreads; None for none."""
    mine, right = moments(log), moments(reference)
    before = _distance(mine, right)
    if not _is_far(mine, right, MAX_DEVIATIONS, MAX_RATIO):
        return None
    found = [
        (_distance(mine, changed), kind, where, changed) for kind, where, changed in _changed(labels, right, normaliser)
    ]
    after, kind, where, changed = min(found, key=lambda each: each[0])
    if after > 0.1 * before or _is_far(mine, changed, FIT_DEVIATIONS, FIT_RATIO):
        return Explanation(
            name, "unexplained", "its values are far from the recorded ones", before, after, len(log), paired=False
        )
    return Explanation(name, kind, where, before, after, len(log), paired=False)


def explain_statistics(
    name: str, labels: Sequence[str], reference: Array, normaliser: Normaliser, *, whole: bool
) -> Explanation | None:
    """Return whether a recording of the training has other means and spreads than the statistics of the spec.

    Args:
        whole: whether it is the policy's own recording, of all tasks and phases.
    """
    mine, (offset, scale) = moments(reference), scales_of(normaliser)
    limits = (WRONG, WRONG_RATIO) if whole and len(reference) >= MIN_ROWS else (MAX_DEVIATIONS, MAX_RATIO)
    away, ratio = np.abs(mine[0] - offset) / scale, mine[1] / scale
    wrong = np.flatnonzero((away > limits[0]) | (ratio > limits[1]) | ((ratio < 1 / limits[1]) & (mine[1] > 1e-9)))
    if not len(wrong):
        return None
    where = f"those of the spec are not of the recorded data in {', '.join(labels[int(index)] for index in wrong)}"
    return Explanation(name, "statistics", where, _distance(mine, (offset, scale)), 0.0, len(reference), remedy=REMEDY)


def scales_of(normaliser: Normaliser) -> Moments:
    """Return offset and scale of a normaliser as float64: mean and standard deviation of the training."""
    return normaliser.offset.astype(np.float64), normaliser.scale.astype(np.float64)


def _is_far(mine: Moments, other: Moments, away: float, ratio: float) -> bool:
    deviations, ratios = _differences(mine, other)
    return bool((deviations > away).any() or (ratios > np.log(ratio)).any())


def _distance(mine: Moments, other: Moments) -> float:
    deviations, ratios = _differences(mine, other)
    return float(np.sqrt(np.mean(np.minimum(deviations, 50) ** 2 + ratios**2)))


def _differences(mine: Moments, other: Moments) -> tuple[Array, Array]:
    """Return the deviations of the means in units of the spread, and the logarithms of the ratio of spreads."""
    moves = (mine[1] > 1e-9) & (other[1] > 1e-9)
    spread = np.where(moves, other[1], 1.0)
    ratios = np.abs(np.log(np.where(moves, mine[1], 1.0) / spread))
    return np.where(moves, np.abs(mine[0] - other[0]) / spread, 0.0), np.where(moves, ratios, 0.0)


def _changed(
    labels: Sequence[str], right: Moments, normaliser: Normaliser | None
) -> Iterator[tuple[str, str, Moments]]:
    """Yield kind, words and the moments that a wrong signal would have."""
    mean, spread = right
    width = len(mean)
    for factor, what in FACTORS.items():
        yield "scaled", f"all elements: {what} (a factor of {factor:.4g})", (factor * mean, factor * spread)
        for index in range(width if width > 1 else 0):
            one = np.where(np.arange(width) == index, factor, 1.0)
            yield "scaled", f"{labels[index]}: {what} (a factor of {factor:.4g})", (one * mean, one * spread)
    if normaliser is not None:
        offset, scale = scales_of(normaliser)
        yield "statistics", "all elements: it is normalised already", ((mean - offset) / scale, spread / scale)
    for index in range(width):
        sign = np.where(np.arange(width) == index, -1.0, 1.0)
        yield "negated", labels[index], (sign * mean, spread)
        for other in range(index):
            order = np.arange(width)
            order[[index, other]] = order[[other, index]]
            words = f"{labels[other]} and {labels[index]} are exchanged"
            yield "permuted", words, (mean[order], spread[order])
