"""Which change of a signal makes it follow the others as in the reference: a search with a likelihood for each change.

Element ``i`` of a log is taken for element ``j`` of the reference, with a sign and a factor, some steps late. What
speaks for that is the sum of two: how much of it the predictions of ``j`` explain (the logarithm of the likelihood
ratio of a regression whose residuals have a memory, with a slope about that of the reference), and whether values and
spreads are those of the reference (Student's t, of as many degrees of freedom as there are tasks: its heavy tails leave
room for another start or task). Elements are assigned to each other by ``scipy.optimize.linear_sum_assignment``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlatool.verify._pairing import MAX_DELAY
from vlatool.verify._series import Series
from vlatool.verify._vectors import FACTORS
from vlatool.verify._views import Prediction, freedom_of

Array = NDArray[np.float64]
KINDS = DELAY_KIND, ORDER_KIND, SIGN_KIND, FACTOR_KIND = "delayed", "permuted", "negated", "scaled"
STATISTICS_KIND = "statistics"
PRIOR = 3.0
"""What each change costs: the logarithm of how much less likely it is than right wiring."""
EARLY_COST = 2 * PRIOR
"""What an early signal costs more than a late one: a sensor does not know what comes."""
SIGNS_FACTORS = [(sign, factor) for factor in (1.0, *FACTORS) for sign in (1, -1)]
SIGNS = np.array([sign for sign, _ in SIGNS_FACTORS], float)[:, None, None]
LOGS = np.log([factor for _, factor in SIGNS_FACTORS])[:, None, None]
COSTS = PRIOR * np.array([(sign < 0) + (factor != 1) for sign, factor in SIGNS_FACTORS])[:, None, None]
DELAYS = sorted(range(-MAX_DELAY, MAX_DELAY + 1), key=lambda delay: (abs(delay), delay < 0))
MIN_ROWS, ROUNDS, MAX_MEMORY, TINY, MIN_RESIDUAL = 6, 2, 0.98, 1e-12, 1e-6
SLOPE_DEVIATIONS = 2.0
"""Deviations of the slope from that of the reference that are allowed."""
VOID = -2 * PRIOR
"""What speaks against a change at most, for each prediction: of an arm that is held, no prediction is right."""


@dataclass(frozen=True, eq=False)
class Levels:
    """Where a signal is in the episodes of a reference, and how far it moves.

    Args:
        centres: (A,) mean of the medians of episodes.
        spreads: (A,) deviation of all values: an episode may be anywhere among them.
        widths: (A,) mean of the logarithm of the deviation in an episode, of those in which the element moves.
        width_spreads: (A,) its deviation; infinite where it never moves.
        still: (A,) deviation below which an element does not move.
        moving, resting: (A,) logarithms of the shares of episodes in which an element moves, and does not.
        freedom: groups less one.
    """

    centres: Array
    spreads: Array
    widths: Array
    width_spreads: Array
    still: Array
    moving: Array
    resting: Array
    freedom: int

    @classmethod
    def of(cls, values: Array, series: Series) -> Levels:
        """Take the levels of a reference."""
        medians, deviations = episodes_of(values, series)
        still = 0.01 * values.std(axis=0) + 1e-9 * (1 + np.abs(values).max(axis=0))
        logs = np.where(deviations > still, np.log(np.maximum(deviations, 1e-300)), np.nan)
        known = np.isfinite(logs).sum(axis=0)
        filled = np.where(np.isfinite(logs), logs, 0.0)
        widths = filled.sum(axis=0) / np.maximum(known, 1)
        square = np.where(np.isfinite(logs), (logs - widths) ** 2, 0.0).sum(axis=0) / np.maximum(known - 1, 1)
        share = (known + 0.5) / (len(medians) + 1)
        width_spreads = np.where(known >= 2, np.maximum(np.sqrt(square), 0.3), np.inf)
        return cls(medians.mean(axis=0), np.maximum(values.std(axis=0), 2 * still), widths, width_spreads, still,
                   np.log(share), np.log(1 - share), freedom_of(series.groups))  # fmt: skip

    def support(self, values: Array, series: Series) -> Array:
        """Return what values and spreads of a log say for each change: (changes, A, A)."""
        medians, deviations = episodes_of(values, series)
        found = np.zeros((len(SIGNS_FACTORS), values.shape[1], len(self.centres)))
        for median, deviation in zip(medians, deviations, strict=True):
            position = SIGNS * median[:, None] / np.exp(LOGS)
            found += _student((position - self.centres) / self.spreads, self.freedom) - np.log(self.spreads)
            moves = deviation[:, None] / np.exp(LOGS) > self.still
            width = np.log(np.maximum(deviation, 1e-300))[:, None] - LOGS - self.widths
            found += np.where(moves, _student(width / self.width_spreads, self.freedom) + self.moving, self.resting)
        supported: Array = found - len(medians) * np.maximum(LOGS, 0.0)
        return supported


def episodes_of(values: Array, series: Series) -> tuple[Array, Array]:
    """Return median of each element in each episode, and its deviation without noise, both (E, A)."""
    parts = [values[series.episodes == number] for number in np.unique(series.episodes)]
    return np.array([np.median(part, axis=0) for part in parts]), np.array([_deviation(part) for part in parts])


def _deviation(values: Array) -> Array:
    """Return the deviation of each element of (N, A) without that of white noise, which second differences show."""
    noise = (np.diff(values, 2, axis=0) ** 2).mean(axis=0) / 6 if len(values) > 2 else 0.0
    deviation: Array = np.sqrt(np.maximum(values.var(axis=0) - noise, 0.0))
    return deviation


def _student(deviations: Array, freedom: int) -> Array:
    """Return the logarithm of Student's density, 0 in its middle."""
    logs: Array = -(freedom + 1) / 2 * np.log1p(deviations**2 / freedom)
    return logs


@dataclass(frozen=True)
class Fix:
    """A change that makes a signal of a log what the reference has.

    Args:
        order: element of the reference that each element of the log holds.
        signs, factors, offsets: an element of the log is ``sign * factor * right + offset``.
        delay: steps by which the log is late.
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    factors: tuple[float, ...]
    offsets: tuple[float, ...]
    delay: int = 0

    def apply(self, values: Array) -> Array:
        """Return the values as they would be with right wiring, without the delay."""
        plain = self.order == tuple(range(len(self.order))) and not any(self.offsets)
        if plain and set(self.signs) == {1} == set(self.factors):
            return values
        right = np.empty_like(values)
        right[:, list(self.order)] = (values - self.offsets) / (np.array(self.signs) * self.factors)
        return right


@dataclass(frozen=True)
class Component:
    """One change of a fix and what speaks for it, as the logarithm of a likelihood ratio.

    Args:
        kind: ``delayed``, ``permuted``, ``negated``, ``scaled`` or ``statistics``.
        elements: elements of the log that it is about, empty for all; the delays that cannot be told from each other.
        factor: of ``scaled``.
        words: of ``statistics``.
    """

    kind: str
    elements: tuple[int, ...]
    evidence: float
    factor: float = 1.0
    negated: bool = False
    words: str = ""


@dataclass(frozen=True, eq=False)
class Finding:
    """The best fix of a signal, with the changes it consists of.

    Args:
        unseen: changes that this log could not show, with what would speak for them.
    """

    fix: Fix
    components: tuple[Component, ...]
    unseen: tuple[Component, ...] = ()

    @property
    def evidence(self) -> float:
        """What speaks for all of it."""
        return sum(each.evidence for each in self.components)

    @property
    def cost(self) -> float:
        """What its changes cost."""
        return PRIOR * sum(each.kind != DELAY_KIND for each in self.components) + _cost(self.fix.delay)


@dataclass(frozen=True, eq=False)
class Tables:
    """What speaks for each element of a log to be one of the reference: delay -> (changes, A, A)."""

    by_delay: Mapping[int, Array]

    @classmethod
    def sum_of(cls, parts: Sequence[Tables]) -> Tables:
        """Return what several logs say together."""
        return cls({delay: np.sum([each.by_delay[delay] for each in parts], axis=0) for delay in parts[0].by_delay})

    def plus(self, more: Mapping[int, Array]) -> Tables:
        """Return tables with what else speaks for the elements, (A, A) for each delay, with any sign and factor."""
        return Tables({delay: table + more[delay] for delay, table in self.by_delay.items()})

    def without_signs(self) -> Tables:
        """Return the same for indices, which have neither sign nor unit."""
        return Tables({delay: np.where(COSTS == 0, table, -1e6) for delay, table in self.by_delay.items()})

    @property
    def right(self) -> float:
        """What speaks for right wiring."""
        return float(self.by_delay[0][0].trace())


def tables(
    predictions: Sequence[Prediction],
    levels: Levels | None,
    series: Series,
    name: str,
    delays: Sequence[int],
    *,
    only_delay: bool,
) -> Tables:
    """Return what speaks for each change of a signal, some steps late."""
    values = series.values[name]
    width = values.shape[1]
    level = levels.support(values, series) if levels else np.zeros((len(SIGNS_FACTORS), width, width))
    predicted = [(each, each.predict(series)) for each in predictions]
    found = {}
    for delay in delays:
        found[delay] = level + sum(_association(each, rows, series, delay) for each, rows in predicted)
    if only_delay:
        found = {
            delay: np.where(np.eye(width, dtype=bool)[None] & (COSTS == 0), each, -1e6) for delay, each in found.items()
        }
    return Tables(found)


def _association(prediction: Prediction, predicted: Array, series: Series, delay: int) -> Array:
    """Return what correlations and slopes say for each change: (changes, A, A)."""
    kept = prediction.view.rows(series, delay)
    width = predicted.shape[1]
    if kept.sum() < MIN_ROWS:
        return np.zeros((len(SIGNS_FACTORS), width, width))
    outcome = prediction.view.outcome(series)
    mine, before = (_centred(outcome[series.rows(delay - back)][kept]) for back in (0, 1))
    theirs, earlier = (_centred(predicted[series.rows(-back)][kept]) for back in (0, 1))
    products = Products.of(mine, before, theirs, earlier)
    slopes, memory = products.regression()
    room = SLOPE_DEVIATIONS * prediction.spreads
    logs = np.log(np.maximum(SIGNS * slopes, 1e-300))
    usual = SIGNS * np.exp(np.clip(logs, LOGS + prediction.slopes - room, LOGS + prediction.slopes + room))
    gain = 0.5 * kept.sum() * np.log(products.own_squares()[:, None] / products.residual_squares(usual, memory))
    found: Array = np.where(np.isfinite(room), np.maximum(gain, VOID), 0.0)
    return found


@dataclass(frozen=True, eq=False)
class Products:
    """Sums of products of a log's elements and of predictions, at the same row and one row apart.

    Args:
        log: (A, 3): squares, with the row before, and squares of that; also what keeps them from 0.
        predicted: (A, 3), the same.
        both: (4, A, A): at the same row, log with the prediction before, log before with prediction, both before.
    """

    log: Array
    predicted: Array
    both: Array

    @classmethod
    def of(cls, mine: Array, before: Array, theirs: Array, earlier: Array) -> Products:
        """Sum products over the rows of (N, A)."""
        both = np.array([mine.T @ theirs, mine.T @ earlier, before.T @ theirs, before.T @ earlier])
        return cls(_squares(mine, before), _squares(theirs, earlier), both)

    def own_squares(self) -> Array:
        """Return the variance of what is new in each row of an element of the log, (A,)."""
        now, with_before, before = self.log.T
        squares: Array = now - with_before**2 / before
        return squares

    def regression(self) -> tuple[Array, Array]:
        """Return slopes, and the memory of the residuals, both (A, A).

        Source: D. Cochrane and G. H. Orcutt, Application of Least Squares Regression to Relationships Containing
        Auto-Correlated Error Terms, JASA 44 (1949).
        """
        memory = np.zeros_like(self.both[0])
        for _ in range(ROUNDS):
            slopes = self._whitened(self.both, memory) / self._squared(self.predicted[None], memory)
            memory = self._memory(slopes)
        return slopes, memory

    def residual_squares(self, slopes: Array, memory: Array) -> Array:
        """Return the sum of squares that is new in each row, for slopes (..., A, A)."""
        whole = self._squared(self.log[:, None], memory)
        left = whole + slopes * (
            slopes * self._squared(self.predicted[None], memory) - 2 * self._whitened(self.both, memory)
        )
        return np.maximum(left, MIN_RESIDUAL * self.own_squares()[:, None])

    def _memory(self, slopes: Array) -> Array:
        _, with_before, before = np.moveaxis(self.log[:, None], -1, 0)
        _, with_earlier, earlier = np.moveaxis(self.predicted[None], -1, 0)
        _, crossed, other, past = self.both
        follow = with_before - slopes * (crossed + other) + slopes**2 * with_earlier
        square = before - 2 * slopes * past + slopes**2 * earlier
        memory: Array = np.clip(follow / np.maximum(square, 1e-12 * before), -MAX_MEMORY, MAX_MEMORY)
        return memory

    @staticmethod
    def _whitened(both: Array, memory: Array) -> Array:
        same, crossed, other, past = both
        whitened: Array = same - memory * (crossed + other) + memory**2 * past
        return whitened

    @staticmethod
    def _squared(sums: Array, memory: Array) -> Array:
        now, with_before, before = np.moveaxis(sums, -1, 0)
        squared: Array = now - 2 * memory * with_before + memory**2 * before
        return squared


def _squares(one: Array, before: Array) -> Array:
    """Return for each element its squares, products and squares before, (A, 3), above 0."""
    now, past = (one**2).sum(axis=0), (before**2).sum(axis=0)
    least = TINY * (1 + now.max())
    return np.stack([now + least, (one * before).sum(axis=0), past + least], axis=1)


def _centred(values: Array) -> Array:
    centred: Array = values - values.mean(axis=0)
    return centred


def search(found: Tables, needed: Mapping[str, float], *, only_delay: bool = False) -> Finding:
    """Return the fix that has most for it, of changes that have more than is needed.

    Args:
        needed: kind of change -> what must speak for it.
    """
    best = {delay: _assigned(table)[1] - _cost(delay) for delay, table in found.by_delay.items()}
    delay = max(best, key=lambda each: best[each])
    components = []
    if delay and best[delay] - best[0] > needed[DELAY_KIND]:
        near = [each for each in best if each * delay > 0 and best[delay] - best[each] <= needed[DELAY_KIND]]
        components.append(Component(DELAY_KIND, tuple(sorted(abs(each) for each in near)), best[delay] - best[0]))
    else:
        delay = 0
    table = found.by_delay[delay]
    width = table.shape[1]
    order, _ = _assigned(table)
    taken = np.arange(width)
    for cycle in cycles(order):
        value = (table - COSTS).max(axis=0)
        gain = sum(value[i, order[i]] - value[i, i] for i in cycle) - PRIOR * (len(cycle) - 1)
        if gain > needed[ORDER_KIND]:
            taken[cycle] = order[cycle]
            components.append(Component(ORDER_KIND, tuple(cycle), float(gain)))
    choices = _choices(table, taken, needed)
    for index, (choice, gain) in choices.items():
        sign, factor = SIGNS_FACTORS[choice]
        components.append(Component(_kind(choice), (index,), gain, factor, sign < 0))
    signs, factors = np.ones(width, int), np.ones(width)
    for index, (choice, _) in choices.items():
        signs[index], factors[index] = SIGNS_FACTORS[choice]
    fix = Fix(tuple(taken.tolist()), tuple(signs.tolist()), tuple(factors.tolist()), (0.0,) * width, delay)
    return Finding(fix, tuple(components), tuple(_unseen(found, delay, taken, needed, only_delay)))


def delay_finding(width: int, delay: int, evidence: float) -> Finding:
    """Return the finding that a signal is some steps late, and nothing else."""
    fix = Fix(tuple(range(width)), (1,) * width, (1.0,) * width, (0.0,) * width, delay)
    return Finding(fix, (Component(DELAY_KIND, (abs(delay),), evidence),))


def _kind(choice: int) -> str:
    return FACTOR_KIND if SIGNS_FACTORS[choice][1] != 1 else SIGN_KIND


def _choices(table: Array, order: NDArray[np.int64], needed: Mapping[str, float]) -> dict[int, tuple[int, float]]:
    """Return element -> sign and factor, as an index of ``SIGNS_FACTORS``, and what speaks for it.

    The change for which most speaks is taken for each element that it fits about as well as the best one does: one
    change of several elements is likelier than several changes.
    """
    gains = table[:, np.arange(len(order)), order]
    gains = gains - gains[0]
    best = (gains - COSTS[..., 0]).argmax(axis=0)
    proven = {index: int(choice) for index, choice in enumerate(best)
              if choice and gains[choice, index] - COSTS[choice, 0, 0] > needed[_kind(int(choice))]}  # fmt: skip
    if not proven:
        return {}
    common = max(proven.items(), key=lambda each: gains[each[1], each[0]])[1]
    for index, choice in enumerate(best):
        gain = gains[common, index]
        if gain > PRIOR and gain - PRIOR > gains[choice, index] - COSTS[choice, 0, 0] - PRIOR:
            proven[index] = common
    return {index: (choice, float(gains[choice, index] - PRIOR)) for index, choice in proven.items()}


def scale_finding(offset: Array, scale: Array, words: str, evidence: float) -> Finding:
    """Return the finding that a signal is ``scale * right + offset``, element by element."""
    width = len(offset)
    fix = Fix(tuple(range(width)), (1,) * width, tuple(scale.tolist()), tuple(offset.tolist()))
    return Finding(fix, (Component(STATISTICS_KIND, (), evidence, words=words),))


def _cost(delay: int) -> float:
    return PRIOR * (delay != 0) + EARLY_COST * (delay < 0) + 0.01 * abs(delay)


def _assigned(table: Array) -> tuple[NDArray[np.int64], float]:
    """Return the element of the reference for each of the log, and what speaks for that."""
    from scipy.optimize import linear_sum_assignment

    value = (table - COSTS).max(axis=0) - PRIOR * (1 - np.eye(table.shape[1]))
    rows, order = linear_sum_assignment(-value)
    return order, float(value[rows, order].sum())


def cycles(order: Sequence[int] | NDArray[np.int64]) -> list[list[int]]:
    """Return the cycles of a permutation that move something."""
    found, seen = [], set[int]()
    for start in range(len(order)):
        cycle, at = [], start
        while at not in seen:
            seen.add(at)
            cycle.append(at)
            at = int(order[at])
        if len(cycle) > 1:
            found.append(cycle)
    return found


def _unseen(
    found: Tables, delay: int, order: NDArray[np.int64], needed: Mapping[str, float], only_delay: bool
) -> list[Component]:
    """Return the changes that would not be found if this log had them, with what would speak for them."""
    table = found.by_delay[delay]
    rows = np.arange(len(order))
    unseen = []
    for late in range(1, MAX_DELAY + 1):
        there = [each for each in (delay - late, delay + late) if each in found.by_delay]
        lost = min(table[0, rows, order].sum() - found.by_delay[each][0, rows, order].sum() for each in there)
        if lost - _cost(late) <= needed[DELAY_KIND]:
            unseen.append(Component(DELAY_KIND, (late,), float(lost - _cost(late))))
    if only_delay:
        return unseen
    for index, other in enumerate(order):
        lost = table[0, index, other] - table[1, index, other] - PRIOR
        if lost <= needed[SIGN_KIND]:
            unseen.append(Component(SIGN_KIND, (index,), float(lost)))
        for second in range(index):
            crossed = table[0, index, order[second]] + table[0, second, other]
            lost = table[0, index, other] + table[0, second, order[second]] - crossed - PRIOR
            if lost <= needed[ORDER_KIND]:
                unseen.append(Component(ORDER_KIND, (second, index), float(lost)))
    return unseen
