"""What tells which discrete command was given: how the image changes with each, and inputs that repeat commands.

A witness gives for each row the logarithm of how much likelier each command is by what follows it than by its share of
the reference. Summed over the rows of a log in which a command was recorded, that is what speaks for it to be another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vlatool.verify._search import Tables
from vlatool.verify._series import Array, Series
from vlatool.verify._views import PLACES, folds, ridge

Rows = NDArray[np.bool_]
MIN_COUNT = 8
"""Rows of a command in the reference from which it is known what follows it."""
SHRINK = 1e-2
"""Penalty of the regressions, for each command one, of an image on the one before."""
SHARPNESS = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.0)
"""Factors of the likelihood among which one is chosen: elements of an image are not independent."""
DOUBTS = (0.01, 0.03, 0.1, 0.3)
"""Shares of rows that are as if another command had been given: something else moved, or nothing could."""
MAX_AGO = 4
"""Control steps ago that an input may repeat a command of."""
MIN_REPEATS = 0.9
"""Share of the uncertainty about a command that an input which repeats it leaves not."""


class Witness(Protocol):
    """Tells commands by a signal."""

    @property
    def source(self) -> str:
        """Name of the signal."""

    def scores(self, series: Series) -> tuple[Array, Rows]:
        """Return what the signal says for each command, (N, commands), and which rows it says it of, (N,)."""

    def own_table(self, series: Series, commands: Array, delay: int) -> Array:
        """Return what commands (N, C) say of the signal, where it is some steps late: for each element, (A, A)."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """How an image changes with each command: a linear map of its places, and what is left of them.

    Args:
        maps: (C, K + 1, K) the constant last.
        variances: (C, K).
        shares: (C,) of the commands in the reference.
        known: (C,) commands that were given often enough.
        sharpness: factor of the likelihood.
        doubt: share of rows that are as if another command had been given.
    """

    source: str
    maps: Array
    variances: Array
    shares: Array
    known: Rows
    sharpness: float
    doubt: float

    @classmethod
    def of(cls, source: str, series: Series, commands: str) -> Dynamics | None:
        """Fit it, and choose how far it is to be believed on groups that it was not fitted to.

        Returns:
            None when nothing is known of any command.
        """
        given, kept = series.values[commands], series.inside(1)
        counts = given[kept].sum(axis=0)
        if (counts >= MIN_COUNT).sum() < 2:
            return None
        shares = (counts + 0.5) / (counts + 0.5).sum()
        logs = np.zeros_like(given)
        for out in folds(series.groups):
            if (~out & kept).sum() >= MIN_COUNT:
                part = _fitted(source, series, given, kept & ~out, shares)
                logs[out] = part.likelihoods(series)[out]
        fitted = _fitted(source, series, given, kept, shares)
        best = max(((sharpness, doubt) for sharpness in SHARPNESS for doubt in DOUBTS),
                   key=lambda each: float((_ratios(logs, shares, *each) * given)[kept].sum()))  # fmt: skip
        return cls(source, fitted.maps, fitted.variances, shares, fitted.known, *best)

    def likelihoods(self, series: Series) -> Array:
        """Return the logarithm of the likelihood of the next image after each command, (N, C)."""
        places = series.values[self.source + PLACES]
        after = places[series.rows(1)]
        predicted = np.einsum("nk,ckl->cnl", places, self.maps[:, :-1]) + self.maps[:, -1][:, None]
        variances = self.variances[:, None]
        logs: Array = -0.5 * ((after - predicted) ** 2 / variances + np.log(variances)).sum(axis=2).T
        return np.where(self.known, logs, logs[:, self.known].mean(axis=1, keepdims=True))

    def scores(self, series: Series) -> tuple[Array, Rows]:
        """Return what the change to the next image says for each command."""
        found = _ratios(self.likelihoods(series), self.shares, self.sharpness, self.doubt)
        return np.where(self.known, found, 0.0), series.inside(1)

    def own_table(self, series: Series, commands: Array, delay: int) -> Array:
        """Return what commands say of the image as a whole, in the first element."""
        width = series.values[self.source].shape[1]
        found, (scores, told) = np.zeros((width, width)), self.scores(series)
        kept = series.inside(delay) & told[series.rows(delay)]
        found[0, 0] = (scores[series.rows(delay)] * commands)[kept].sum()
        return found


def _fitted(source: str, series: Series, given: Array, kept: Rows, shares: Array) -> Dynamics:
    places = series.values[source + PLACES]
    after = places[series.rows(1)]
    maps, variances, known = [], [], []
    whole = after[kept].var(axis=0) + 1e-9
    for command in given.T > 0:
        rows = command & kept
        known.append(rows.sum() >= MIN_COUNT)
        if not known[-1]:
            maps.append(np.zeros((places.shape[1] + 1, places.shape[1])))
            variances.append(whole)
            continue
        maps.append(ridge(places[rows], after[rows], SHRINK))
        left = after[rows] - places[rows] @ maps[-1][:-1] - maps[-1][-1]
        freedom = max(1, int(rows.sum()) - places.shape[1] - 1)
        variances.append((left**2).sum(axis=0) / freedom + 1e-3 * whole)
    return Dynamics(source, np.array(maps), np.array(variances), shares, np.array(known), 1.0, 0.0)


def _ratios(logs: Array, shares: Array, sharpness: float, doubt: float) -> Array:
    """Return the logarithm of how much likelier each command is than its share."""
    scaled = sharpness * logs + np.log(shares)
    believed = np.exp(scaled - scaled.max(axis=1, keepdims=True))
    believed = (1 - doubt) * believed / believed.sum(axis=1, keepdims=True) + doubt * shares
    ratios: Array = np.log(believed / shares)
    return ratios


@dataclass(frozen=True, eq=False)
class Repeat:
    """An input that repeats the command of some steps ago.

    Args:
        ago: control steps.
        ratios: (V, C) logarithm of how much likelier each value is after each command than by its share.
    """

    source: str
    ago: int
    ratios: Array

    @classmethod
    def of(cls, source: str, series: Series, commands: str) -> Repeat | None:
        """Find the step that the input repeats, by the information on it; None when it repeats none."""
        given, values, best = series.values[commands], series.values[source], None
        for ago in range(MAX_AGO + 1):
            kept = series.inside(ago)
            both = values[series.rows(ago)][kept].T @ given[kept] + 1e-3
            both = both / both.sum()
            apart = both.sum(axis=1, keepdims=True) * both.sum(axis=0)
            entropy = -(both.sum(axis=0) * np.log(both.sum(axis=0))).sum()
            share = float((both * np.log(both / apart)).sum() / max(entropy, 1e-9))
            if kept.sum() >= MIN_COUNT and share >= MIN_REPEATS and (best is None or share > best[0]):
                counts = values[series.rows(ago)][kept].T @ given[kept] + 0.5
                likely, whole = counts / counts.sum(axis=0), counts.sum(axis=1, keepdims=True) / counts.sum()
                best = share, cls(source, ago, np.log(likely / whole))
        return best[1] if best else None

    def scores(self, series: Series) -> tuple[Array, Rows]:
        """Return what the input says for each command."""
        values = series.values[self.source][series.rows(self.ago)]
        return values @ self.ratios, series.inside(self.ago) & (values.sum(axis=1) > 0)

    def own_table(self, series: Series, commands: Array, delay: int) -> Array:
        """Return what commands say for each value of the input to be another."""
        at = self.ago + delay
        kept = series.inside(at)
        found: Array = series.values[self.source][series.rows(at)][kept].T @ (commands[kept] @ self.ratios.T)
        return found


def witnesses(series: Series, commands: str, images: Sequence[str], codes: Sequence[str]) -> list[Witness]:
    """Return what tells the commands of a reference."""
    found = [Dynamics.of(name, series, commands) for name in images]
    repeats = [Repeat.of(name, series, commands) for name in codes]
    return [each for each in (*found, *repeats) if each is not None]


def with_witnesses(found: Tables, known: Sequence[Witness], series: Series, name: str, commands: str) -> Tables:
    """Return tables of a signal with what witnesses say: of the commands, or of the signal that one is."""
    given, mine = series.values[commands], [each for each in known if each.source == name]
    more = {}
    for delay, table in found.by_delay.items():
        told = [_of_commands(each, series, given, delay) for each in known] if name == commands else []
        told += [each.own_table(series, given, delay) for each in mine]
        more[delay] = np.sum(told, axis=0) if told else np.zeros(table.shape[1:])
    return found.plus(more)


def _of_commands(witness: Witness, series: Series, given: Array, delay: int) -> Array:
    scores, told = witness.scores(series)
    kept = told & series.inside(delay)
    found: Array = given[series.rows(delay)][kept].T @ scores[kept]
    return found
