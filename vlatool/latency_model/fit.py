"""Fit the latency model: scales by leaving models and devices out whole, intervals by conformal scores."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vlatool.errors import DataError, OutputError
from vlatool.files.printable import amount
from vlatool.latency_model.features import Shares, rows_of
from vlatool.latency_model.folds import UNITS, Folds, Sample
from vlatool.latency_model.gaussian_process import Scales
from vlatool.latency_model.model import DATA, LEVEL, LatencyModel, TrainingData, read_model, write
from vlatool.latency_model.published_latencies import Point, merge_versions, read_points
from vlatool.runtime.interface import Array

TAIL_WEIGHT = 0.3
"""Weight of the 90th percentile relative to the median."""
DEVICE_WEIGHT = 0.6
"""Weight of an unseen device relative to an unseen model."""
CALIBRATED_WEIGHT, MAX_SEARCH_MODELS = 0.6, 6
"""Weight of a device with one known model; number of its models in the search for scales."""
INITIAL_STEP, MIN_STEP = 0.5, 0.04
"""Steps of the search for scales, in their logarithm: the first, and the smallest."""
MAX_SEARCH_FIGURES = 32
"""Largest number of figures of one device, runtime and precision in the search for scales."""


def loss(error: Array) -> float:
    """Return the weighted sum of median and 90th percentile of the relative error."""
    if not len(error):
        return 0.0
    relative = np.abs(np.expm1(error))
    return float(np.median(relative) + TAIL_WEIGHT * np.quantile(relative, 0.9))


def search_objective(sample: Sample, scales: Scales, shares: Shares) -> float:
    """Return the objective that the search for scales minimizes."""
    folds = Folds(rows_of(sample.questions, shares), sample, scales)
    likelihood = 0.0
    total = 0.0
    for groups, weight in ((sample.models, 1.0), (sample.devices, DEVICE_WEIGHT)):
        error, deviation = folds.leave_out(groups)
        total += weight * loss(error)
        likelihood += weight * float(np.mean(np.log(deviation) + 0.5 * (error / deviation) ** 2))
    total += CALIBRATED_WEIGHT * loss(folds.leave_out_calibrated(sample.devices, MAX_SEARCH_MODELS)[0])
    return total + LIKELIHOOD_WEIGHT * likelihood


LIKELIHOOD_WEIGHT = 0.05
"""Weight of the predictive likelihood, which keeps the intervals honest where the error is indifferent."""


def tune(
    sample: Sample,
    scales: Scales,
    shares: Shares,
    seconds: float,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Scales, Shares]:
    """Search scales and shares by coordinate descent in the logarithm, until the time is over.

    Args:
        seconds: Time limit of the search.
        seed: Random seed of the order of the coordinates.
    """
    names = [field.name for field in dataclasses.fields(Scales) if field.name != "constant"]
    names += [f"shares.{field.name}" for field in dataclasses.fields(Shares)]
    random = np.random.default_rng(seed)
    steps = dict.fromkeys(names, INITIAL_STEP)  # with the sign of the direction that helped last
    best = search_objective(sample, scales, shares)
    started = time.monotonic()
    while active := [name for name in names if abs(steps[name]) > MIN_STEP]:
        for name in random.permutation(active):
            if time.monotonic() - started > seconds:
                return scales, shares
            improved = False
            for step in (steps[name], -steps[name]):
                candidate = _scaled_parameter(scales, shares, name, math.exp(step))
                cost = search_objective(sample, *candidate) if candidate else math.inf
                if cost < best - 1e-4:
                    (scales, shares), best, improved = candidate or (scales, shares), cost, True
                    steps[name] = step
                    tell(f"{time.monotonic() - started:.0f} s, {name}: {best:.4f}")
                    break
            steps[name] *= 1.3 if improved else 0.6
    return scales, shares


def _scaled_parameter(scales: Scales, shares: Shares, name: str, factor: float) -> tuple[Scales, Shares] | None:
    part = name.removeprefix("shares.")
    if part == name:
        return replace(scales, **{name: getattr(scales, name) * factor}), shares
    value = getattr(shares, part) * factor
    return None if part != "layers" and value > 1 else (scales, replace(shares, **{part: value}))


def conformal(sample: Sample, scales: Scales, shares: Shares) -> dict[str, dict[str, float]]:
    """Return regime -> unit -> standard deviations that cover ``LEVEL`` of the left-out figures (split conformal).

    A unit with few models or devices is shrunk towards all units of the regime (``Scores.quantile``).
    """
    rows = rows_of(sample.questions, shares)
    folds = Folds(rows, sample, scales)
    spans: dict[str, dict[str, float]] = {}
    for regime, scores in (
        ("known", Scores.for_sample(sample, *folds.leave_out(sample.models), sample.models, sample.models)),
        ("unseen", Scores.for_sample(sample, *folds.leave_out(sample.devices), sample.devices, rows.keys["pair"])),
        ("calibrated", Scores.for_calibrated(sample, folds)),
    ):
        spans[regime] = {unit: scores.quantile(number) for number, unit in enumerate(UNITS)}
    return spans


SHRINKAGE_COUNT = 4
"""Weight of all units together, in models or devices of one unit: few of them say little."""


@dataclass(frozen=True)
class Scores:
    """Distances of left-out figures in standard deviations.

    Args:
        values: (n,) distance of each published figure, versions of a runtime counted separately.
        groups: (n,) group that it was left out with.
        units: (n,) index into ``UNITS``.
        draws: (n,) index of the draw: a model; a device with a runtime and precision; a device with the model that
            calibrates it.
    """

    values: Array
    groups: Array
    units: Array
    draws: Array

    @staticmethod
    def for_sample(sample: Sample, error: Array, deviation: Array, groups: Array, draws: Array) -> Scores:
        """Return the scores of every row of a sample."""
        figure_rows = sample.figures
        values = np.abs(error[figure_rows] + sample.logs[figure_rows] - sample.published) / deviation[figure_rows]
        return Scores(values, groups[figure_rows], sample.units[figure_rows], draws[figure_rows])

    @staticmethod
    def for_calibrated(sample: Sample, folds: Folds) -> Scores:
        """Return the scores of devices with one known model, for many of their models."""
        error, deviation, rows, draws = folds.leave_out_calibrated(sample.devices)
        order = np.argsort(sample.figures, kind="stable")
        starts = np.searchsorted(sample.figures[order], np.arange(len(sample.logs) + 1))
        copies = np.diff(starts)[rows]  # versions of each row
        copy = np.repeat(np.arange(len(rows)), copies)
        figure = order[np.repeat(starts[rows] - np.append(0, np.cumsum(copies)[:-1]), copies) + np.arange(len(copy))]
        at = rows[copy]
        values = np.abs(error[copy] + sample.logs[at] - sample.published[figure]) / deviation[copy]
        return Scores(values, sample.devices[at], sample.units[at], draws[copy])

    def quantile(self, unit: int, but: int | None = None) -> float:
        """Return the ``LEVEL`` quantile of a unit's scores, shrunk towards that of all units where it has few groups.

        Args:
            unit: Index into ``UNITS``.
            but: Excluded group.
        """
        others = np.ones(len(self.values), bool) if but is None else self.groups != but
        alike = others & (self.units == unit)
        if not others.any():
            return math.inf
        apart = len(np.unique(self.groups[alike]))
        own = self._share(alike) if apart else 0.0
        return (apart * own + SHRINKAGE_COUNT * self._share(others)) / (apart + SHRINKAGE_COUNT)

    def _share(self, rows: Array) -> float:
        """Return the ``LEVEL`` quantile of the scores of some rows."""
        values, groups, draws = self.values[rows], self.groups[rows], len(np.unique(self.draws[rows]))
        _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
        weights = counts[inverse] ** -0.5  # figures of one group are not independent
        order = np.argsort(values)
        share = np.cumsum(weights[order]) / weights.sum()
        level = LEVEL * (draws + 1) / draws  # a prediction is one draw more (Lei et al., JASA 2018, section 2)
        return float(values[order][min(len(order) - 1, int(np.searchsorted(share, level)))])


PARTS = ("processors", "npu")


def split_by_part(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Return the points of each process."""
    kept = [point for point in points if point.question is not None]
    return {part: [point for point in kept if (point.kind == "npu") == (part == "npu")] for part in PARTS}


def subsample(points: Sequence[Point], limit: int = MAX_SEARCH_FIGURES, seed: int = 0) -> list[Point]:
    """Return a random subset of at most ``limit`` figures of each device, runtime and precision.

    The search for scales needs no more of them, and its cost grows with the third power.
    """
    random = np.random.default_rng(seed)
    alike: dict[tuple[str, ...], list[Point]] = {}
    for point in merge_versions(points):
        if asked := point.question:
            alike.setdefault((point.group, asked.compute_unit.unit, asked.runtime, asked.precision), []).append(point)
    drawn = (random.permutation(len(same))[:limit] for same in alike.values())
    return [same[index] for same, indices in zip(alike.values(), drawn, strict=True) for index in sorted(indices)]


def fit(
    points: Sequence[Point], before: LatencyModel | None, seconds: float, seed: int, tell: Callable[[str], None]
) -> LatencyModel:
    """Return the model of some figures.

    Args:
        before: Start of the search for scales; ``Scales()`` and ``Shares()`` when None.
        seconds: Time limit of the search; 0 keeps the scales.
    """
    parts: dict[str, TrainingData] = {}
    shares: dict[str, Shares] = {}
    bounds: dict[str, dict[str, dict[str, float]]] = {}
    usable = {part: mine for part, mine in split_by_part(points).items() if mine}
    subsamples = {part: subsample(mine, seed=seed) for part, mine in usable.items()}
    work = {part: float(len(mine)) ** 3 for part, mine in subsamples.items()}  # of one assessment
    for part, mine in usable.items():
        sample = Sample.from_points(mine)
        groups = f"{amount(len(set(sample.devices)), 'device')} and {amount(len(set(sample.models)), 'model')}"
        tell(f"{part}: {amount(len(sample.published), 'figure')} of {groups}")
        begin = (Scales(), Shares())
        if before is not None and part in before.parts:
            begin = (before.parts[part].scales, before.shares[part])
        progress: list[str] = []
        share = seconds * work[part] / sum(work.values())
        scales, shares[part] = tune(Sample.from_points(subsamples[part]), *begin, share, seed, progress.append)
        for line in progress[-3:]:
            tell(line)
        bounds[part] = conformal(sample, scales, shares[part])
        parts[part] = TrainingData(rows_of(sample.questions, shares[part]), sample.logs, scales)
    about = {"figures": sum(len(known.rows) for known in parts.values()), "seed": seed, "level": LEVEL}
    return LatencyModel(parts, shares, bounds, about)


def _refuse_foreign_files(out: Path) -> None:
    """Refuse files with the model's names that are not a model."""
    present = [out / name for name in ("latency.npz", "latency.json") if os.path.lexists(out / name)]
    if not present:
        return
    try:
        is_ours = set(json.loads((out / "latency.json").read_text(encoding="utf-8"))) == {"about", "parts"}
        is_ours = is_ours and zipfile.is_zipfile(out / "latency.npz") and not any(path.is_symlink() for path in present)
    except (OSError, ValueError, TypeError, RecursionError):
        is_ours = False
    if not is_ours:
        raise OutputError(f"{present[0]} is not a model that vlatool wrote.", "name another directory, or move it away")


def fit_files(
    path: Path, out: Path, seconds: float, seed: int, anew: bool = False, tell: Callable[[str], None] = lambda _: None
) -> None:
    """Fit on a file and write the model's data.

    Args:
        anew: Start the search for scales at ``Scales()`` and ``Shares()``, instead of those of the shipped model, which
            was fitted on all published figures.

    Raises:
        DataError: when the file is malformed, or has no row to fit on.
        OutputError: when other files have the names of the model's files.
    """
    _refuse_foreign_files(out)
    points = read_points(path)
    shipped = not anew and (DATA / "latency.json").is_file()
    before = read_model(DATA) if shipped else None  # and not the user's own: the search begins at what was shipped
    if not any(point.question for point in points):
        raise DataError(
            f"{path} has no row to fit on: {next(point.why for point in points)}.",
            "add rows of models and devices that vlatool knows; docs/concepts/latency-model.md names the columns",
        )
    out.mkdir(parents=True, exist_ok=True)  # before the search: its minutes are not to be lost
    model = fit(points, before, seconds, seed, tell)
    write(model, out)
    tell(f"written: {out / 'latency.npz'}, {out / 'latency.json'}")
