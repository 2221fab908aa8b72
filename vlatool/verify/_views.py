"""What one signal tells of another: fitted on a reference, and how far that holds in episodes it was not fitted on.

A view predicts a signal from others by ridge regression over a window of control steps. How much of a log's signal a
prediction explains does not depend on where the arm started or which task it had, which means and spreads do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlatool.verify._series import Series

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
WINDOW = range(-6, 4)
"""Control steps of the sources that a row is predicted from."""
RIDGE = 1e-3
MAX_FREEDOM = 10
"""Degrees of freedom at most: the next task is never like all others."""
MIN_SPREAD = 0.1
"""Least spread of the logarithm of a slope: a gain differs by so much from day to day."""
CHANGE, PLACE, VALUE, MOTION = "change", "place", "value", "motion"
"""What a view predicts: steps of a signal, its place in the episode, its value, or the motion in an image."""
PLACES_KNOWN = 60
LEADS = (0.0, 0.25, -0.25, 0.5, -0.5)
"""Parts of a control step by which an image may be ahead of the sensors in the reference, too."""


@dataclass(frozen=True)
class View:
    """Which signal is predicted, as what, and from which.

    Args:
        target: name of the signal.
        kind: ``CHANGE``, ``PLACE``, ``VALUE`` or ``MOTION``.
        sources: names of the signals it is predicted from.
        commands: whether these are commands, whose values matter, not their changes.
    """

    target: str
    kind: str
    sources: tuple[str, ...]
    commands: bool = False

    def outcome(self, series: Series) -> Array:
        """Return what is predicted, (N, A)."""
        if self.kind == CHANGE:
            return series.change(self.target)
        return series.from_mean(self.target) if self.kind == PLACE else series.values[self.target]

    def rows(self, series: Series, delay: int = 0) -> NDArray[np.bool_]:
        """Return which rows can be judged, and the one before each, where the signal is read some steps ahead: (N,)."""
        kept = series.inside(-1) & series.inside(delay - 1) & series.inside(delay)
        return kept & series.inside(delay + 1) & series.inside(1) if self.kind in (CHANGE, MOTION) else kept

    def features(self, series: Series, basis: Basis) -> Array:
        """Return what it is predicted from, (N, F)."""
        if self.kind == PLACE:
            return np.concatenate([series.from_mean(name) for name in self.sources], axis=1)
        if self.kind == MOTION:
            return basis.features(series, self.sources)
        parts = []
        for name in self.sources:
            values = series.values[name] if self.commands else series.change(name)
            parts += [part[series.rows(ahead)] for ahead in WINDOW for part in (values, np.abs(values))]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False)
class Basis:
    """Places of an arm about which it moves: what an image changes by depends on where the arm is.

    Args:
        centres: (K, A) places, of the reference.
        scale: (A,) deviation of each element.
        lead: part of a control step that the image is ahead of the arm's sensors, -1 to 1.
    """

    centres: Array
    scale: Array
    lead: float = 0.0

    @classmethod
    def of(cls, series: Series, sources: Sequence[str], lead: float = 0.0) -> Basis:
        """Take places that are spread over a reference."""
        values = np.concatenate([series.values[name] for name in sources], axis=1)
        chosen = np.unique(np.linspace(0, len(values) - 1, PLACES_KNOWN).astype(int))
        return cls(values[chosen], values.std(axis=0) + 1e-9, lead)

    def features(self, series: Series, sources: Sequence[str]) -> Array:
        """Return how near the arm comes to each place, how fast it moves there, and each element: (N, 2 (K + A)).

        Of how fast an element moves also the root, since the motion in a part of an image is measured as a root.
        """
        values = np.concatenate([series.values[name] for name in sources], axis=1) / self.scale
        centres = self.centres / self.scale
        squares = (values**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2 * values @ centres.T
        near = np.exp(-np.maximum(squares, 0) / values.shape[1])
        ahead = series.rows(1)
        moved = np.abs(values[ahead] - values)
        speed = np.sqrt((moved**2).sum(axis=1, keepdims=True))
        found = np.concatenate([near[ahead] - near, speed * near, moved, np.sqrt(moved)], axis=1)
        share = abs(self.lead)
        return (1 - share) * found + share * found[series.rows(1 if self.lead > 0 else -1)] if share else found


@dataclass(frozen=True, eq=False)
class Prediction:
    """A view that was fitted, and what its predictions are worth for other episodes.

    Args:
        weights: (F + 1, A).
        slopes: (A,) mean of the logarithm of the slope of a signal against its prediction.
        spreads: (A,) its deviation from task to task.
        freedom: tasks, of which the slopes are, less one.
        worth: (A,) correlation of prediction and signal.
    """

    view: View
    basis: Basis
    weights: Array
    slopes: Array
    spreads: Array
    worth: Array
    freedom: int

    def predict(self, series: Series) -> Array:
        """Return the prediction for each row, (N, A)."""
        features = self.view.features(series, self.basis)
        predicted: Array = features @ self.weights[:-1] + self.weights[-1]
        return predicted


def ridge(features: Array, outcome: Array, penalty: float = RIDGE) -> Array:
    """Return the weights of a ridge regression, the constant last: (F + 1, A)."""
    mean, scale = features.mean(axis=0), features.std(axis=0) + 1e-12
    scaled = (features - mean) / scale
    gram = scaled.T @ scaled + penalty * len(scaled) * np.eye(scaled.shape[1])
    centre = outcome.mean(axis=0)
    weights = np.linalg.solve(gram, scaled.T @ (outcome - centre)) / scale[:, None]
    return np.concatenate([weights, (centre - mean @ weights)[None]])


def folds(groups: Indices, most: int = 8) -> list[NDArray[np.bool_]]:
    """Return which rows are left out together: whole groups, in ``most`` parts at most."""
    numbers = np.unique(groups)
    return [np.isin(groups, part) for part in np.array_split(numbers, min(most, len(numbers)))]


def fit(view: View, series: Series, lead: float = 0.0) -> Prediction:
    """Fit a view, and take what it is worth from predictions for groups that were left out."""
    basis = Basis.of(series, view.sources, lead)
    kept = series.inside(1) if view.kind in (CHANGE, MOTION) else np.ones(len(series), bool)
    features, outcome = view.features(series, basis)[kept], view.outcome(series)[kept]
    episodes, groups = series.episodes[kept], series.groups[kept]
    predicted = np.zeros_like(outcome)
    for out in folds(groups):
        if out.all():
            predicted[:] = outcome.mean(axis=0)
            break
        weights = ridge(features[~out], outcome[~out])
        predicted[out] = features[out] @ weights[:-1] + weights[-1]
    logs = np.array([_log_slopes(outcome[rows], predicted[rows]) for rows in _stretches(episodes)])
    means, spreads = _moments(logs)
    worth = np.nan_to_num(_correlations(outcome, predicted))
    return Prediction(view, basis, ridge(features, outcome), means, spreads, worth, freedom_of(series.groups))


def _stretches(episodes: Indices) -> list[Indices]:
    return [np.flatnonzero(episodes == number) for number in np.unique(episodes)]


def freedom_of(groups: Indices) -> int:
    """Return the degrees of freedom of what was taken from so many groups."""
    return int(np.clip(len(np.unique(groups)) - 1, 2, MAX_FREEDOM))


def _moments(logs: Array) -> tuple[Array, Array]:
    """Return mean and deviation of the logarithms of slopes; no slope is expected where there are too few."""
    known = np.isfinite(logs)
    counts = np.maximum(known.sum(axis=0), 1)
    means = np.where(known, logs, 0.0).sum(axis=0) / counts
    spreads = np.sqrt((np.where(known, logs - means, 0.0) ** 2).sum(axis=0) / np.maximum(counts - 1, 1))
    return means, np.where(known.sum(axis=0) >= 2, np.maximum(spreads, MIN_SPREAD), np.inf)


def _correlations(one: Array, other: Array) -> Array:
    """Return the correlation of each column with that of the other, 0 where one is constant."""
    one, other = one - one.mean(axis=0), other - other.mean(axis=0)
    size = np.sqrt((one**2).sum(axis=0) * (other**2).sum(axis=0))
    correlations: Array = (one * other).sum(axis=0) / np.where(size > 1e-12, size, np.inf)
    return correlations


def _log_slopes(outcome: Array, predicted: Array) -> Array:
    """Return the logarithm of the slope of each column against its prediction; NaN where it has none."""
    one, other = outcome - outcome.mean(axis=0), predicted - predicted.mean(axis=0)
    slopes = (one * other).sum(axis=0) / np.maximum((other**2).sum(axis=0), 1e-18)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(np.where((slopes > 0) & (_correlations(one, other) > 0.3), slopes, np.nan))


def views_of(
    vectors: Sequence[str], images: Sequence[str], commands: str, *, dense: bool, discrete: bool = False
) -> list[View]:
    """Return what is predicted from what: vectors from the commands, or the others, and images from the vectors.

    Args:
        discrete: whether the commands are indices, which images have other witnesses for.
    """
    found = [View(name, PLACE, tuple(f"{image}{PLACES}" for image in images)) for name in vectors if images]
    if not dense:
        return found
    for name in vectors:
        others = (commands,) if commands else tuple(other for other in (*vectors, *images) if other != name)
        found += [View(name, CHANGE, others, bool(commands))] if others else []
    for name in images:
        if vectors:
            found.append(View(name, MOTION, tuple(vectors)))
        elif commands and not discrete:
            found.append(View(name, VALUE, (commands,), commands=True))
    if commands and (sources := tuple(vectors) or (() if discrete else tuple(images))):
        found.append(View(commands, VALUE, sources))
    return found


PLACES = " seen"
"""Added to the name of an image: where its components are."""


def fit_all(views: Sequence[View], series: Series, leads: Mapping[str, float]) -> Mapping[str, list[Prediction]]:
    """Return the fitted views of each signal.

    Args:
        leads: image -> part of a control step that it is ahead.
    """
    found: dict[str, list[Prediction]] = {}
    for view in views:
        found.setdefault(view.target, []).append(fit(view, series, leads.get(view.target, 0.0)))
    return found


def leads_of(views: Sequence[View], series: Series) -> dict[str, float]:
    """Return by which part of a step each image is ahead: that with which a whole step, late or early, fits worst."""
    found = {}
    for view in views:
        if view.kind == MOTION:
            margins = {lead: _margin(fit(view, series, lead), series) for lead in LEADS}
            found[view.target] = max(LEADS, key=lambda lead: margins[lead])
    return found


def _margin(prediction: Prediction, series: Series) -> float:
    """Return how much better the signal fits in time than a step late or early, by squares of what is new in a row."""
    predicted, outcome = prediction.predict(series), prediction.view.outcome(series)
    fits = []
    for delay in (0, 1, -1):
        kept = prediction.view.rows(series, delay)
        new = [(values[series.rows(at)] - values[series.rows(at - 1)])[kept]
               for values, at in ((outcome, delay), (predicted, 0))]  # fmt: skip
        fits.append(float((-np.log1p(-(np.clip(_correlations(*new), 0, 0.999) ** 2))).sum()))
    return fits[0] - max(fits[1:])
