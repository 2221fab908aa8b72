"""What holds between the signals of right episodes, and which change makes a log hold it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vlatool.verify._bounds import MIN_LOG, Bounds, Needed, Nulls, episode_parts, task_parts, upper_bound
from vlatool.verify._reading import Names
from vlatool.verify._search import DELAYS, Finding, Levels, Tables, search, tables
from vlatool.verify._series import Series
from vlatool.verify._views import Prediction, fit_all, leads_of, views_of
from vlatool.verify._witnesses import Witness, with_witnesses, witnesses


@dataclass(frozen=True, eq=False)
class Model:
    """What holds between the signals of right episodes, and how far a right episode is from it.

    Args:
        witnesses: what tells commands that are indices.
        bounds: (whether the tasks are known, whether there is no more noise than in the reference) -> what is needed.
        needed: what is needed in the log that is judged.
        usual: signal -> roughness that the episodes of the reference have at most.
    """

    names: Names
    predictions: Mapping[str, list[Prediction]]
    levels: Mapping[str, Levels]
    discrete: bool
    leads: Mapping[str, float]
    witnesses: tuple[Witness, ...] = ()
    bounds: Mapping[tuple[bool, bool], Bounds] = field(default_factory=dict)
    needed: Needed = field(default_factory=dict)
    usual: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, names: Names, series: Series, discrete: bool, leads: Mapping[str, float] | None = None) -> Model:
        """Fit what holds between signals."""
        views = views_of(names.vectors, names.images, names.commands, dense=names.dense, discrete=discrete)
        leads = leads_of(views, series) if leads is None else leads
        predictions = fit_all(views, series, leads)
        measured = (*names.vectors, *([names.commands] if names.commands and not discrete else []))
        levels = {name: Levels.of(series.values[name], series) for name in measured}
        codes = [name for name in names.codes if name in series.values]
        known = (
            witnesses(series, names.commands, names.images, codes)
            if discrete and names.commands and names.dense
            else ()
        )
        return cls(names, predictions, levels, discrete, leads, tuple(known))

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals that can be judged."""
        known = (*self.names.vectors, *self.names.images, *self.names.codes, self.names.commands)
        told = {each.source for each in self.witnesses} | ({self.names.commands} if self.witnesses else set())
        return tuple(name for name in known if name in self.predictions or name in self.levels or name in told)

    def tables(self, series: Series, name: str, delays: Sequence[int] = DELAYS) -> Tables:
        """Return what speaks for each change of a signal of a log."""
        images, views = name in self.names.images, self.predictions.get(name, ())
        found = tables(views, self.levels.get(name), series, name, delays, only_delay=images)
        if self.witnesses:
            found = with_witnesses(found, self.witnesses, series, name, self.names.commands)
        indices = name in self.names.codes or (self.discrete and name == self.names.commands)
        return found.without_signs() if indices else found

    def all_tables(self, series: Series) -> dict[str, Tables]:
        """Return what speaks for each change of each signal of a log."""
        return {name: self.tables(series, name) for name in self.signals}

    def finding(self, series: Series, name: str, needed: Mapping[str, float]) -> Finding:
        """Return the best change of a signal."""
        return search(self.tables(series, name), needed, only_delay=name in self.names.images)

    def fit_of(self, series: Series, names: Sequence[str] = ()) -> float:
        """Return what speaks for some signals as they are, for all without names."""
        return sum(self.tables(series, name, (0,)).right for name in names or self.signals)

    def with_bounds(self, series: Series, noisy: Series, shifted: Series) -> Model:
        """Return the model with what is needed: from episodes, judged by a model of the other tasks, and of the others.

        Args:
            noisy: the same episodes, seen by sensors with more noise.
            shifted: the same, seen by cameras that stand otherwise.
        """
        rows = max(MIN_LOG, len(series) / len(np.unique(series.episodes)))
        bounds: dict[tuple[bool, bool], Bounds] = {}
        for known, parts in ((False, task_parts(series)), (True, episode_parts(series))):
            clean, rough = Nulls(), Nulls()
            for out, logs in parts:
                other = Model.of(self.names, series.part(~out), self.discrete, self.leads)
                for each, nulls in ((series, clean), (shifted, clean), (noisy, rough)):
                    nulls.add([other.all_tables(each.part(np.isin(each.episodes, log))) for log in logs],
                              self.names.images)  # fmt: skip
            if not known:
                bounds = {(False, True): clean.bounds(self.signals, rows),
                          (False, False): clean.bounds(self.signals, rows, rough)}  # fmt: skip
            for quiet, others in ((True, ()), (False, (rough,))):
                new = bounds[False, quiet]
                bounds[True, quiet] = (
                    clean.bounds(self.signals, rows, *others).with_delays_of(new) if clean.found else new
                )
        episodes = [series.part(series.episodes == number) for number in np.unique(series.episodes)]
        usual = {name: upper_bound([roughness(each, name) for each in episodes], 0.0) for name in self.signals}
        return replace(self, usual=usual, bounds=bounds)

    def for_log(self, series: Series, *, known: bool) -> Model:
        """Return the model with what is needed in a log of this noise and length.

        Args:
            known: whether the reference has other episodes of each task of the log.
        """
        quiet = all(roughness(series, name) <= self.usual.get(name, np.inf) for name in self.signals)
        return replace(self, needed=self.bounds[known, quiet].threshold(len(series)))


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
