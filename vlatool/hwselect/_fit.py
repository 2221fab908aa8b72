"""Fit the latency model: scales by cross-validation over whole models and whole devices, intervals by conformal scores.

Leaving a group out of a Gaussian process needs no second fit: with A the inverse of the covariance of all rows, the
group's mean is y_g - inv(A_gg) (A y)_g and its covariance inv(A_gg) (Rasmussen and Williams 2006, section 5.4.2).
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError
from vlatool.hwselect._features import Question, Shares, rows_of
from vlatool.hwselect._latency import DATA, LEVEL, Known, LatencyModel, read_model, write
from vlatool.hwselect._points import Point, merged, read_points
from vlatool.hwselect._process import Rows, Scales, kernel

Array = NDArray[Any]
TAIL = 0.3
"""What the 90th percentile counts beside the median."""
DEVICES = 0.6
"""What an unseen device counts beside an unseen model."""
CALIBRATED, QUICK = 0.6, 6
"""What a device counts of which one model is known; how many of its models are tried in the search for scales."""
STEP = 0.5
UNITS = ("cpu", "gpu", "igpu", "npu")
LONGEST = 32
"""Models that calibrate a held-out device, one after the other, at most."""


@dataclass(frozen=True)
class Sample:
    """The rows that a fit works on.

    Args:
        questions: One for each row.
        logs: (n,) natural logarithm of ms.
        models, devices: (n,) codes of the groups that are left out whole.
        units: (n,) index into ``UNITS``.
        figures: (m,) row of each published figure: several versions of a runtime are one row.
        published: (m,) their logarithms.
    """

    questions: tuple[Question, ...]
    logs: Array
    models: Array
    devices: Array
    units: Array
    figures: Array
    published: Array

    @staticmethod
    def of(points: Sequence[Point]) -> Sample:
        """Take the points that can be asked about, one row for each question."""
        asked = [point for point in points if point.question is not None]
        known = merged(asked)
        row = {point.question: place for place, point in enumerate(known)}
        figures = np.array([row[point.question] for point in asked], np.int64)
        published = np.array([point.log_ms for point in asked])
        models, devices = (_codes([getattr(each, name) for each in known]) for name in ("model", "group"))
        units = np.array([UNITS.index(point.kind) for point in known])
        questions = tuple(point.question for point in known if point.question is not None)
        logs = np.array([point.log_ms for point in known])
        return Sample(questions, logs, models, devices, units, figures, published)


def _codes(names: Sequence[str]) -> Array:
    known = {name: code for code, name in enumerate(sorted(set(names)))}
    return np.array([known[name] for name in names])


class Folds:
    """Predictions of each row without its group.

    Args:
        rows: Of the sample.
        sample: The sample.
        scales: Of the process.
    """

    def __init__(self, rows: Rows, sample: Sample, scales: Scales) -> None:
        covariance = kernel(rows, rows, scales)
        covariance[np.diag_indices(len(rows))] += scales.noise**2
        self._inverse = np.linalg.inv(covariance)
        self._residual = sample.logs - rows.prior
        self._weights = self._inverse @ self._residual
        self._sample = sample

    def without(self, groups: Array) -> tuple[Array, Array]:
        """Return error of log(ms) (predicted less measured) and its predicted standard deviation, row by row."""
        error, deviation = np.zeros(len(groups)), np.zeros(len(groups))
        for index, mean, covariance in self._each(groups):
            error[index], deviation[index] = mean - self._residual[index], np.sqrt(np.diag(covariance))
        return error, deviation

    def calibrated(self, groups: Array, most: int = LONGEST) -> tuple[Array, Array, Array]:
        """Leave each device out, tell the process of one of its models, and predict the others; for many of its models.

        Args:
            groups: Devices.
            most: Models of each that are told, one after the other.

        Returns:
            Errors, standard deviations and the rows that they belong to.
        """
        errors: list[Array] = []
        deviations: list[Array] = []
        places: list[Array] = []
        for index, mean, covariance in self._each(groups):
            models = np.unique(self._sample.models[index])
            for model in models[:: max(1, -(-len(models) // most))]:
                seen = self._sample.models[index] == model
                rest = ~seen
                if not rest.any():
                    continue
                across = covariance[np.ix_(rest, seen)] @ np.linalg.inv(covariance[np.ix_(seen, seen)])
                told = self._residual[index][seen] - mean[seen]
                errors.append(mean[rest] + across @ told - self._residual[index][rest])
                spread = np.diag(covariance)[rest] - np.einsum("ij,ij->i", across, covariance[np.ix_(rest, seen)])
                deviations.append(np.sqrt(np.maximum(spread, 1e-9)))
                places.append(index[rest])
        if not errors:  # every device has one model alone
            return np.zeros(0), np.zeros(0), np.zeros(0, np.int64)
        return np.concatenate(errors), np.concatenate(deviations), np.concatenate(places)

    def once(self, groups: Array, random: np.random.Generator) -> tuple[Array, Array, Array]:
        """Leave each device out, tell the process of one of its models, drawn at random, and predict the others.

        Returns:
            Error and standard deviation of each row, and which rows were told.
        """
        error, deviation = np.zeros(len(groups)), np.ones(len(groups))
        told = np.zeros(len(groups), bool)
        for index, mean, covariance in self._each(groups):
            models = np.unique(self._sample.models[index])
            seen = self._sample.models[index] == models[random.integers(len(models))]
            told[index[seen]] = True
            if seen.all():
                continue
            across = covariance[np.ix_(~seen, seen)] @ np.linalg.inv(covariance[np.ix_(seen, seen)])
            known = self._residual[index][seen] - mean[seen]
            error[index[~seen]] = mean[~seen] + across @ known - self._residual[index][~seen]
            spread = np.diag(covariance)[~seen] - np.einsum("ij,ij->i", across, covariance[np.ix_(~seen, seen)])
            deviation[index[~seen]] = np.sqrt(np.maximum(spread, 1e-9))
        return error, deviation, told

    def _each(self, groups: Array) -> Iterator[tuple[Array, Array, Array]]:
        for code in np.unique(groups):
            index = np.flatnonzero(groups == code)
            covariance = np.linalg.inv(self._inverse[np.ix_(index, index)])
            yield index, self._residual[index] - covariance @ self._weights[index], covariance


def loss(error: Array) -> float:
    """Return median and 90th percentile of the relative error, weighed."""
    if not len(error):
        return 0.0
    off = np.abs(np.expm1(error))
    return float(np.median(off) + TAIL * np.quantile(off, 0.9))


def assess(sample: Sample, scales: Scales, shares: Shares) -> float:
    """Return what the search for scales lowers."""
    folds = Folds(rows_of(sample.questions, shares), sample, scales)
    likelihood = 0.0
    total = 0.0
    for groups, weight in ((sample.models, 1.0), (sample.devices, DEVICES)):
        error, deviation = folds.without(groups)
        total += weight * loss(error)
        likelihood += weight * float(np.mean(np.log(deviation) + 0.5 * (error / deviation) ** 2))
    total += CALIBRATED * loss(folds.calibrated(sample.devices, QUICK)[0])
    return total + LIKELIHOOD * likelihood


LIKELIHOOD = 0.05
"""What the predictive likelihood counts: it keeps the intervals honest where the error alone does not care."""


def tune(
    sample: Sample,
    scales: Scales,
    shares: Shares,
    seconds: float,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Scales, Shares]:
    """Search scales and shares by coordinates, in the logarithm, until the time is over.

    Args:
        seconds: For the search.
        seed: Of the order of the coordinates.
        tell: Called with each improvement.
    """
    names = [field.name for field in dataclasses.fields(Scales) if field.name != "constant"]
    names += [f"shares.{field.name}" for field in dataclasses.fields(Shares)]
    random = np.random.default_rng(seed)
    steps = dict.fromkeys(names, STEP)
    best = assess(sample, scales, shares)
    begun = time.monotonic()
    while time.monotonic() - begun < seconds and max(steps.values()) > 0.04:
        for name in random.permutation(names):
            if time.monotonic() - begun > seconds:
                break
            better = False
            for factor in (math.exp(steps[name]), math.exp(-steps[name])):
                tried = _changed(scales, shares, name, factor)
                found = assess(sample, *tried) if tried else math.inf
                if found < best - 1e-4:
                    (scales, shares), best, better = tried or (scales, shares), found, True
                    tell(f"{time.monotonic() - begun:.0f} s, {name}: {best:.4f}")
                    break
            steps[name] *= 1.3 if better else 0.6
    return scales, shares


def _changed(scales: Scales, shares: Shares, name: str, factor: float) -> tuple[Scales, Shares] | None:
    part = name.removeprefix("shares.")
    if part == name:
        return replace(scales, **{name: getattr(scales, name) * factor}), shares
    value = getattr(shares, part) * factor
    return None if part != "layers" and value > 1 else (scales, replace(shares, **{part: value}))


def conformal(sample: Sample, scales: Scales, shares: Shares) -> dict[str, dict[str, float]]:
    """Return regime -> unit -> how many standard deviations reach ``LEVEL`` of what is left out (split conformal).

    Where a unit has too few rows, all of the regime speak for it.
    """
    folds = Folds(rows_of(sample.questions, shares), sample, scales)
    found: dict[str, dict[str, float]] = {}
    for regime, scores in (
        ("known", Scores.of(sample, *folds.without(sample.models), sample.models)),
        ("unseen", Scores.of(sample, *folds.without(sample.devices), sample.devices)),
        ("calibrated", Scores.calibrated(sample, folds)),
    ):
        found[regime] = {unit: scores.reach(number) for number, unit in enumerate(UNITS)}
    return found


FEW = 12
"""Scores from which a unit speaks for itself."""


@dataclass(frozen=True)
class Scores:
    """How many standard deviations left-out figures are away.

    Args:
        values: (n,) for each published figure, several versions of a runtime apart.
        groups: (n,) what it was left out with.
        units: (n,) index into ``UNITS``.
    """

    values: Array
    groups: Array
    units: Array

    @staticmethod
    def of(sample: Sample, error: Array, deviation: Array, groups: Array) -> Scores:
        """Return the scores of every row of a sample."""
        place = sample.figures
        values = np.abs(error[place] + sample.logs[place] - sample.published) / deviation[place]
        return Scores(values, groups[place], sample.units[place])

    @staticmethod
    def calibrated(sample: Sample, folds: Folds) -> Scores:
        """Return the scores of devices of which one model is known, for many of their models."""
        error, deviation, places = folds.calibrated(sample.devices)
        order = np.argsort(sample.figures, kind="stable")
        starts = np.searchsorted(sample.figures[order], np.arange(len(sample.logs) + 1))
        copies = np.diff(starts)[places]  # versions of each row
        each = np.repeat(np.arange(len(places)), copies)
        figure = order[np.repeat(starts[places] - np.append(0, np.cumsum(copies)[:-1]), copies) + np.arange(len(each))]
        at = places[each]
        values = np.abs(error[each] + sample.logs[at] - sample.published[figure]) / deviation[each]
        return Scores(values, sample.devices[at], sample.units[at])

    def reach(self, unit: int, but: int | None = None) -> float:
        """Return the score that ``LEVEL`` do not exceed, from this unit's (all units' when there are few).

        Args:
            unit: Index into ``UNITS``.
            but: A group that takes no part.
        """
        others = np.ones(len(self.values), bool) if but is None else self.groups != but
        alike = others & (self.units == unit)
        speak = alike if alike.sum() >= FEW else others
        if not speak.any():
            return math.inf
        values, groups = self.values[speak], self.groups[speak]
        _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
        weights = counts[inverse] ** -0.5  # figures of one group are no independent witnesses
        order = np.argsort(values)
        share = np.cumsum(weights[order]) / weights.sum()
        return float(values[order][min(len(order) - 1, int(np.searchsorted(share, LEVEL)))])


PARTS = ("processors", "npu")


def fitted(points: Sequence[Point], like: LatencyModel) -> LatencyModel:
    """Return the model with the scales of another one, given these points."""
    parts: dict[str, Known] = {}
    for part, mine in by_part(points).items():
        if not mine:
            continue
        sample = Sample.of(mine)
        parts[part] = Known(rows_of(sample.questions, like.shares[part]), sample.logs, like.parts[part].scales)
    return LatencyModel(parts, like.shares, like.conformal, like.about)


def by_part(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Return the points of each process."""
    kept = [point for point in points if point.question is not None]
    return {part: [point for point in kept if (point.kind == "npu") == (part == "npu")] for part in PARTS}


def fit_files(path: Path, out: Path, seconds: float, seed: int, anew: bool = False) -> Iterator[str]:
    """Fit on a file and write the model's data; yields what is done.

    Args:
        anew: Begin the search for scales at ``Scales()`` and ``Shares()``, and not at those of the shipped model, which
            saw all that was published.

    Raises:
        DataError: when the file is malformed.
    """
    points = read_points(path)
    parts: dict[str, Known] = {}
    shares: dict[str, Shares] = {}
    bounds: dict[str, dict[str, dict[str, float]]] = {}
    told: list[str] = []
    usable = {part: mine for part, mine in by_part(points).items() if mine}
    if not usable:
        why = next((point.why for point in points if point.why), "no row")
        raise DataError(f"{path} has no row to fit on: {why}.")
    out.mkdir(parents=True, exist_ok=True)
    for part, mine in usable.items():
        sample = Sample.of(mine)
        before = _before(part, anew)
        groups = f"{len(set(sample.devices))} devices and {len(set(sample.models))} models"
        yield f"{part}: {len(sample.published)} figures of {groups}"
        scales, shares[part] = tune(sample, *before, seconds / len(usable), seed, told.append)
        yield from told[-3:]
        bounds[part] = conformal(sample, scales, shares[part])
        parts[part] = Known(rows_of(sample.questions, shares[part]), sample.logs, scales)
    about = {"figures": sum(len(known.rows) for known in parts.values()), "seed": seed, "level": LEVEL}
    write(LatencyModel(parts, shares, bounds, about), out)
    yield f"written: {out / 'latency.npz'}, {out / 'latency.json'}"


def _before(part: str, anew: bool) -> tuple[Scales, Shares]:
    if anew or not (DATA / "latency.json").is_file():
        return Scales(), Shares()
    model = read_model(DATA)  # and not the user's own: the search begins at what was shipped
    return (model.parts[part].scales, model.shares[part]) if part in model.parts else (Scales(), Shares())
