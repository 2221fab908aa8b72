"""What holds between the signals of right episodes, and which change makes a log hold it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vlatool.stats.intervals import student
from vlatool.verify._reading import Names
from vlatool.verify._search import (
    DELAY_KIND,
    DELAYS,
    KINDS,
    PRIOR,
    Finding,
    Levels,
    Tables,
    delay_finding,
    scale_finding,
    search,
    tables,
)
from vlatool.verify._series import Array, Series
from vlatool.verify._views import PLACES, Prediction, fit_all, folds, leads_of, views_of

MAX_FOLDS = 16
MIN_LOG = 50
"""Rows of the reference, of whole episodes, that are judged as if they were a log: in fewer, nothing is found."""
ALARM = 1e-3
"""Share of right logs in which a kind of change of a signal may be found."""
MIN_EVIDENCE = float(np.log(1 / ALARM))
Scales = Mapping[str, tuple[Array, Array]]
"""Signal -> offset and scale of its normalisation."""


@dataclass(frozen=True, eq=False)
class Model:
    """What holds between the signals of right episodes, and how far a right episode is from it.

    Args:
        needed: signal -> kind of change -> what must speak for it, so that it is not found in a right log.
        needed_rough: the same for logs with more noise than the reference.
        usual: signal -> roughness that the episodes of the reference have at most.
        rows: of an episode of the reference, on average.
    """

    names: Names
    predictions: Mapping[str, list[Prediction]]
    levels: Mapping[str, Levels]
    discrete: bool
    leads: Mapping[str, float]
    needed: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    needed_rough: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    usual: Mapping[str, float] = field(default_factory=dict)
    rows: float = 1.0

    @classmethod
    def of(cls, names: Names, series: Series, discrete: bool, leads: Mapping[str, float] | None = None) -> Model:
        """Fit what holds between signals."""
        views = views_of(names.vectors, names.images, names.commands, dense=names.dense)
        leads = leads_of(views, series) if leads is None else leads
        predictions = fit_all(views, series, leads)
        measured = (*names.vectors, *([names.commands] if names.commands and not discrete else []))
        return cls(
            names, predictions, {name: Levels.of(series.values[name], series) for name in measured}, discrete, leads
        )

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals that can be judged."""
        known = (*self.names.vectors, *self.names.images, self.names.commands)
        return tuple(name for name in known if name in self.predictions or name in self.levels)

    def tables(self, series: Series, name: str) -> Tables:
        """Return what speaks for each change of a signal of a log."""
        found = tables(
            self.predictions.get(name, ()), self.levels.get(name), series, name, only_delay=name in self.names.images
        )
        return found.without_signs() if self.discrete and name == self.names.commands else found

    def finding(self, series: Series, name: str, needed: Mapping[str, float]) -> Finding:
        """Return the best change of a signal."""
        return search(self.tables(series, name), needed, only_delay=name in self.names.images)

    def fit_of(self, series: Series) -> float:
        """Return what speaks for all signals as they are."""
        return sum(self.tables(series, name).right for name in self.signals)

    def with_bounds(self, series: Series, noisy: Series, shifted: Series) -> Model:
        """Return the model with what is needed: from each episode, judged by a model of the other tasks.

        Args:
            noisy: the same episodes, seen by sensors with more noise.
            shifted: the same, seen by cameras that stand otherwise.
        """
        clean: Nulls = {name: {kind: [] for kind in KINDS} for name in self.signals}
        rough: Nulls = {name: {kind: [] for kind in KINDS} for name in self.signals}
        for out, logs in _parts(series):
            other = Model.of(self.names, series.part(~out), self.discrete, self.leads)
            for log, found in ((each.part(np.isin(each.episodes, numbers)), found) for numbers in logs
                               for each, found in ((series, clean), (shifted, clean), (noisy, rough))):  # fmt: skip
                for name in self.signals:
                    components = other.finding(log, name, dict.fromkeys(KINDS, 0.0)).components
                    for kind in KINDS:
                        found[name][kind].append(max((e.evidence for e in components if e.kind == kind), default=0.0))
        parts = [series.part(series.episodes == number) for number in np.unique(series.episodes)]
        usual = {name: upper_bound([roughness(part, name) for part in parts], 0.0) for name in self.signals}
        rows = max(MIN_LOG, float(np.mean([len(part) for part in parts])))
        return replace(self, usual=usual, rows=rows, needed=_bounds(clean), needed_rough=_bounds(clean, rough))

    def for_log(self, series: Series) -> Model:
        """Return the model with what is needed in a log of this noise and length.

        What a right episode has for a change because predictions are not exact grows with its rows, and what it has by
        chance with their root, since residuals hang together over more rows than the regression knows.
        """
        quiet = all(roughness(series, name) <= self.usual.get(name, np.inf) for name in self.signals)
        longer = max(1.0, len(series) / self.rows)
        needed = {
            name: {kind: MIN_EVIDENCE * longer**0.5 + longer * (value - MIN_EVIDENCE) for kind, value in each.items()}
            for name, each in (self.needed if quiet else self.needed_rough).items()
        }
        return replace(self, needed=needed)


Nulls = dict[str, dict[str, list[float]]]


def _bounds(*nulls: Nulls) -> dict[str, dict[str, float]]:
    return {name: {kind: max(upper_bound(each[name][kind]) for each in nulls) for kind in KINDS} for name in nulls[0]}


def roughness(series: Series, name: str) -> float:
    """Return how much of the steps of a signal is noise: the root mean square of their changes relative to theirs."""
    kept = series.inside(1) & series.inside(2)
    if name not in series.values or not kept.any():
        return 0.0
    step = series.change(name)
    square = (step[kept] ** 2).sum(axis=0)
    change = ((step[series.rows(1)] - step)[kept] ** 2).sum(axis=0)
    moves = square > 1e-12 * (1 + square.max())
    return float(np.sqrt(change[moves] / square[moves]).mean()) if moves.any() else 0.0


def _parts(series: Series) -> Iterator[tuple[NDArray[np.bool_], list[list[int]]]]:
    """Yield which rows are left out together, and logs made of their episodes, of ``MIN_LOG`` rows or more each."""
    for out in folds(series.groups, MAX_FOLDS):
        if out.all():
            return
        logs: list[list[int]] = [[]]
        for number in np.unique(series.episodes[out]).tolist():
            logs[-1].append(number)
            if np.isin(series.episodes, logs[-1]).sum() >= MIN_LOG:
                logs.append([])
        yield out, [each for each in logs if each]


def upper_bound(values: Sequence[float], least: float = MIN_EVIDENCE) -> float:
    """Return what another right log exceeds with the chance ``ALARM``, and no value here does.

    The bound of Student's distribution for one more value of a normal sample; without a sample that of likelihood
    ratios, of which a right log exceeds ``log(1 / ALARM)`` with the chance ``ALARM`` at most.
    """
    if len(values) < 2:
        return 2 * least
    spread = float(np.std(values, ddof=1)) * math.sqrt(1 + 1 / len(values))
    return max(least, *values, float(np.mean(values)) + student(1 - ALARM, len(values) - 1) * spread)


def explain(model: Model, series: Series, scales: Scales) -> tuple[list[tuple[str, Finding]], Series]:
    """Return the signals that are wrong with their findings, and the log as it would be without these.

    One after the other: of the signals that a change would make right, the one whose change makes all of them fit best.

    Args:
        scales: signal -> offset and scale of its normalisation.
    """
    found: list[tuple[str, Finding]] = []
    while True:
        taken = {name for name, _ in found}
        fixes = [(_gain(model, series, finding, fixed), name, finding, fixed)
                 for name, finding, fixed in _candidates(model, series, scales) if name not in taken]  # fmt: skip
        best = max(fixes, key=lambda each: each[0], default=None)
        if best is None or best[0] <= min(model.needed[best[1]].values()):
            return found, series
        found.append((best[1], best[2]))
        series = best[3]


def _gain(model: Model, series: Series, finding: Finding, fixed: Series) -> float:
    """Return how much better all signals fit with a change, on the rows that it leaves."""
    before = model.fit_of(series.part(series.inside(finding.fix.delay)))
    return model.fit_of(fixed) - before - finding.cost


def _late_commands(model: Model, series: Series, evidence: float) -> Iterator[tuple[str, Finding, Series]]:
    """Yield delays of the commands, which a delay of what follows them may be just as well."""
    name = model.names.commands
    width = series.values[name].shape[1] if name else 0
    for delay in DELAYS[1:] if name else ():
        finding = delay_finding(width, delay, evidence)
        yield name, finding, series.with_signals((name,), finding.fix.apply, delay)


def _with_places(name: str, series: Series) -> tuple[str, ...]:
    """Return a signal and, of an image, its places, which are late with it."""
    return (name, name + PLACES) if name + PLACES in series.values else (name,)


def _candidates(model: Model, series: Series, scales: Scales) -> Iterator[tuple[str, Finding, Series]]:
    """Yield the signals that a change makes fit, and the log with it."""
    late = 0.0
    for name in model.signals:
        finding = model.finding(series, name, model.needed[name])
        late = max(late, *(each.evidence for each in finding.components if each.kind == DELAY_KIND), 0.0)
        if finding.components:
            yield name, finding, series.with_signals(_with_places(name, series), finding.fix.apply, finding.fix.delay)
        if name not in scales:
            continue
        offset, scale = scales[name]
        before = model.tables(series, name).right
        for words, one, other in (("it is normalised already", -offset / scale, 1 / scale),
                                  ("it was un-normalised once more", offset, scale)):  # fmt: skip
            fixed = series.with_signals((name,), scale_finding(one, other, words, 0.0).fix.apply)
            evidence = model.tables(fixed, name).right - before - PRIOR
            if evidence > max(model.needed[name].values()):
                yield name, scale_finding(one, other, words, evidence), fixed
    if late:
        yield from _late_commands(model, series, late)
