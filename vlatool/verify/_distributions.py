"""Whether the statistics of a spec are those of the recordings that the policy was trained on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.statistics import Normaliser
from vlatool.verify._explanation import Explanation

Array = NDArray[np.float64]
Moments = tuple[Array, Array]
"""Mean and standard deviation of each element."""
MAX_DEVIATIONS, MAX_RATIO = 4.0, 6.0
"""Deviations of a mean, and ratio of a spread, that other episodes do not explain."""
WRONG, WRONG_RATIO, MIN_ROWS = 1.5, 4.0, 64
"""Deviations and ratio by which statistics are not those of a whole training recording, of so many rows."""
EDGES = {"min_max": (0.0, 1.0), "quantiles": (0.01, 0.99), "quantile10": (0.1, 0.9)}
"""Quantiles that become -1 and 1."""
REMEDY = "name the statistics that the policy was trained with in its spec"


def moments(values: Array) -> Moments:
    """Return mean and standard deviation of each element of (N, A)."""
    return values.mean(axis=0), values.std(axis=0)


def explain_statistics(
    name: str, labels: Sequence[str], reference: Array, normaliser: Normaliser, kind: str, *, whole: bool
) -> Explanation | None:
    """Return whether a recording of the training has other statistics than the spec.

    Args:
        kind: ``mean_std``, ``min_max``, ``quantiles`` or ``quantile10``.
        whole: whether it is the policy's own recording, of all tasks and phases.
    """
    mine, (offset, scale) = statistics_of(reference, kind), scales_of(normaliser)
    limits = (WRONG, WRONG_RATIO) if whole and len(reference) >= MIN_ROWS else (MAX_DEVIATIONS, MAX_RATIO)
    away, ratio = np.abs(mine[0] - offset) / scale, mine[1] / scale
    wrong = np.flatnonzero((away > limits[0]) | (ratio > limits[1]) | ((ratio < 1 / limits[1]) & (mine[1] > 1e-9)))
    if not len(wrong):
        return None
    where = f"those of the spec are not of the recorded data in {', '.join(labels[int(index)] for index in wrong)}"
    return Explanation(name, "statistics", where, _distance(mine, (offset, scale)), 0.0, len(reference), remedy=REMEDY)


def statistics_of(values: Array, kind: str) -> Moments:
    """Return offset and scale of each element of (N, A), as a normalisation of that kind has them."""
    if kind == "mean_std":
        return moments(values)
    low, high = np.quantile(values, EDGES[kind], axis=0)
    return (low + high) / 2, (high - low) / 2


def scales_of(normaliser: Normaliser) -> Moments:
    """Return offset and scale of a normaliser as float64: mean and standard deviation of the training."""
    return normaliser.offset.astype(np.float64), normaliser.scale.astype(np.float64)


def _distance(mine: Moments, other: Moments) -> float:
    deviations, ratios = _differences(mine, other)
    return float(np.sqrt(np.mean(np.minimum(deviations, 50) ** 2 + ratios**2)))


def _differences(mine: Moments, other: Moments) -> tuple[Array, Array]:
    """Return the deviations of the means in units of the spread, and the logarithms of the ratio of spreads."""
    moves = (mine[1] > 1e-9) & (other[1] > 1e-9)
    spread = np.where(moves, other[1], 1.0)
    ratios = np.abs(np.log(np.where(moves, mine[1], 1.0) / spread))
    return np.where(moves, np.abs(mine[0] - other[0]) / spread, 0.0), np.where(moves, ratios, 0.0)
