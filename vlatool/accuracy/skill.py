"""Whether actions say anything about the observation: their skill against the best constant action, and how they vary.

A skill (of a forecast: 1 - error / error of the reference forecast) is 0 for whoever does no better than the one action
that would have been right most often, and 1 for the expert.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.accuracy.losses import losses, spread_of
from vlatool.bundle.spec import TensorSpec
from vlatool.measures.actions import SKILL_EXPERT, VARIATION
from vlatool.report import Measurement
from vlatool.stats.intervals import paired_drop, student

Array = NDArray[Any]
CONFIDENCE = 0.95
FEWEST = 8
"""Samples below which nothing is said of how much actions vary."""
CLUSTERS = 8
"""Episodes from which on whole episodes are the units of an interval; samples are, with fewer."""


def skill(action: TensorSpec, got: Array, expert: Array, episodes: Array | None = None) -> Measurement:
    """Return the share of the best constant action's error that the policy does not make, with its interval.

    Args:
        got, expert: (N, T, A) in physical units, or (N, T) indices.
        episodes: (N,) episode of each sample.
    """
    if action.kind != "discrete":
        steps = min(got.shape[1], expert.shape[1])
        got, expert = got[:, :steps], expert[:, :steps]
    constant = best_constant(action, expert)
    idle, own = losses(action, constant, expert), losses(action, got, expert)
    floor = float(idle.mean())
    if floor == 0.0 or (action.kind != "discrete" and not spread_of(expert).any()):
        note = "the expert's action never varies, so a policy cannot be told from a constant one"
        return SKILL_EXPERT.measurement(math.nan, samples=len(got), note=note)
    low, high = _interval(idle - own, episodes, action.kind == "discrete")
    return SKILL_EXPERT.measurement(
        float((idle - own).mean()) / floor, samples=len(got), low=low / floor, high=high / floor,
        confidence=CONFIDENCE, note=f"1 - error / error of the best constant action, which is {floor:.4g}",
    )  # fmt: skip


def best_constant(action: TensorSpec, expert: Array) -> Array:
    """Return the chunk that, always given, has the least error against the expert, once for each sample."""
    if action.kind == "discrete":
        flat = expert.reshape(len(expert), -1)
        labels = max(len(action.labels), int(flat.max()) + 1)
        best = [np.bincount(column, minlength=labels).argmax() for column in flat.T]
        return np.broadcast_to(np.asarray(best), flat.shape).reshape(expert.shape)
    return np.broadcast_to(np.median(expert, axis=0), expert.shape)


def _interval(gain: Array, episodes: Array | None, answers: bool) -> tuple[float, float]:
    """Return the bounds of a mean gain; whole episodes are its units where there are enough, for samples are alike."""
    value = float(gain.mean())
    bounds = []
    if answers:
        won, lost = int((gain > 0).sum()), int((gain < 0).sum())
        bounds.append(paired_drop(won, lost, len(gain), CONFIDENCE)[1:])
    units = gain
    if episodes is not None and len(np.unique(episodes)) >= CLUSTERS:
        units = np.asarray([gain[episodes == episode].mean() for episode in np.unique(episodes)])
    if len(units) < 2:
        return -1.0, 1.0
    half = student((1 + CONFIDENCE) / 2, len(units) - 1) * float(units.std(ddof=1)) / math.sqrt(len(units))
    bounds.append((value - half, value + half))
    return min(low for low, _ in bounds), max(high for _, high in bounds)


def variation(action: TensorSpec, got: Array, expert: Array | None) -> list[Measurement]:
    """Return how much the actions vary, against the expert's where there is one; 0 when they never do.

    Discrete: the share of answers that are not the most frequent one. Nothing for fewer than ``FEWEST`` samples.
    """
    if len(got) < FEWEST:
        return []
    if action.kind == "discrete":
        value = 1.0 - float(np.bincount(got.reshape(-1)).max()) / got.size
        return [VARIATION.measurement(value, samples=len(got), note="share without the most frequent answer")]
    own, note = got.astype(np.float64).std(axis=0).mean(axis=0), "standard deviation / largest size"
    scale = np.abs(got).max(axis=(0, 1)).astype(np.float64)
    if expert is not None:
        steps = min(got.shape[1], expert.shape[1])
        own, note = got[:, :steps].astype(np.float64).std(axis=0).mean(axis=0), "standard deviation / the expert's"
        scale = expert[:, :steps].astype(np.float64).std(axis=0).mean(axis=0)
        scale = np.where(spread_of(expert) > 0, scale, 0.0)
    moved = scale > 0
    if not moved.any():
        return [VARIATION.measurement(0.0, samples=len(got), note=note)] if expert is None else []
    value = float(np.mean(own[moved] / scale[moved]))
    return [VARIATION.measurement(value if value > 1e-6 else 0.0, samples=len(got), note=note)]
