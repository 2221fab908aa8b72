"""Motion of a variant relative to its baseline: in the episodes in which both succeed, and by task."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.accuracy.doubt import MIN_KNOWN_SHARE, Cause, Doubt
from vlatool.measures import Quantity, series, tables
from vlatool.measures.motion import ADDED_MEAN, RATIO, STEPS_RATIO
from vlatool.measures.success import WORST_TASK_DROP
from vlatool.motion.measure import MIN_PAIRS, metrics, ratio_of
from vlatool.report import NO_INTERVAL, Measurement, Row
from vlatool.stats.intervals import sign_test
from vlatool.stats.starts import distinct_starts, independent_starts
from vlatool.stats.success_sequential import exact_drop

Array = NDArray[np.float64]
AGAINST = {series.TASK: tables.AGAINST_BY_TASK, series.INSTRUCTION: tables.AGAINST_BY_INSTRUCTION}
WORST_TASK_PREFIX = ", the worst of "
"""Text after the name of the task in the note of that measurement."""
CONFIDENCE = 0.95
DOUBT = 0.25
"""Chance (an exact sign test) below which it is not an accident that the variant's values are missing more often: the
doubt is not the baseline's, so that two episodes suffice."""
LONGEST = 20
"""Tasks, or instructions, of a table: those that lose most."""


def compare_motion(baseline: Row, row: Row) -> Row:
    """Return the row with how it moves as a multiple of the baseline, its worst task, and both by task.

    Args:
        baseline, row: rows of ``success_row`` for the same episodes.
    """
    pairs = _Pairs(baseline, row)
    tables = {title: table for key, title in AGAINST.items() if (table := pairs.table(key))}
    found = (*(ratio.measured for _, ratio in pairs.ratios()), *pairs.added_motion(), *pairs.steps(), *pairs.worst())
    return replace(row, measurements=(*row.measurements, *found), details={**row.details, **tables})


class Ratio(NamedTuple):
    """A metric as a multiple of the baseline's, and what its note adds: what is unknown, where it is largest."""

    measured: Measurement
    remarks: tuple[str, ...] = ()


def ratios(baseline: Row, row: Row, names: Collection[str], confidence: float = CONFIDENCE) -> dict[str, Ratio]:
    """Return metric -> how a variant moves as a multiple of the baseline, in episodes in which both succeed.

    Args:
        baseline, row: rows of ``success_row`` for the same episodes.
        names: Metrics; those that the episodes do not have are left out.
        confidence: Coverage of each interval.
    """
    return {name: ratio for name, ratio in _Pairs(baseline, row, confidence).ratios() if name in names}


def doubts(baseline: Row, row: Row, names: Collection[str]) -> dict[str, Doubt]:
    """Return metric -> why its missing values leave nothing to be claimed of it; those that are known are left out.

    Args:
        baseline, row: rows of ``success_row`` for the same episodes.
        names: Metrics; those that the baseline's episodes do not have are left out.
    """
    pairs, known = _Pairs(baseline, row), known_of(baseline)
    return {name: why for name in names if name in known and (why := pairs.doubt(name))}


def known_of(baseline: Row) -> list[str]:
    """Return the metrics that episodes of the baseline have in which it succeeds, whatever a variant has."""
    won = np.asarray(baseline.raw[series.SUCCESS]) > 0
    metrics = series.METRIC.among(baseline.raw).items()
    return sorted(one for one, name in metrics if np.isfinite(np.asarray(baseline.raw[name], np.float64)[won]).any())


def pairs_above_none(baseline: Row, row: Row, names: Collection[str]) -> dict[str, tuple[int, int]]:
    """Return metric -> in how many of the episodes in which both succeed a variant has any, and of how many.

    Args:
        baseline, row: rows of ``success_row`` for the same episodes.
        names: Metrics; those of which the baseline has some, or that the episodes do not have, are left out.
    """
    return {name: counts for name, counts in _Pairs(baseline, row).above_none() if name in names}


def drops_by_task(baseline: Row, row: Row, confidence: float = CONFIDENCE) -> dict[str, Measurement]:
    """Return task -> how many more of its episodes fail, a share, with intervals of a joint coverage (Bonferroni)."""
    return _Pairs(baseline, row, confidence).drops()


def worst_task(drop: Measurement) -> str:
    """Return the name of the task that a measurement of ``WORST_TASK_DROP`` is about."""
    return drop.note.partition(WORST_TASK_PREFIX)[0]


def _ratio(
    quantity: Quantity, ratio: tuple[float, float, float], count: int, note: Sequence[str], confidence: float,
    doubt: Doubt | None = None,
) -> Ratio:  # fmt: skip
    """Return a ratio; without its interval where there is a doubt, or resamples in which the baseline's is always 0."""
    low: float | None
    high: float | None
    value, low, high = ratio
    what, *remarks = note
    if doubt or not np.isfinite(high):
        doubt = doubt or Doubt(Cause.FEW_PAIRS if count < MIN_PAIRS else Cause.ZEROS, count)
        low = high = None
        remarks.insert(0, f"{NO_INTERVAL}{doubt}")
    words = "; ".join((what, *remarks))
    measured = quantity.measurement(value, samples=count, low=low, high=high, confidence=confidence, note=words)
    return Ratio(measured, tuple(remarks))


class _Pairs:
    """Two rows, episode by episode."""

    def __init__(self, baseline: Row, row: Row, confidence: float = CONFIDENCE) -> None:
        self._rows, self._confidence = (baseline, row), confidence
        self._wins = tuple(self._of(one, series.SUCCESS) > 0 for one in self._rows)
        self._both = self._wins[0] & self._wins[1]
        self._starts = np.asarray(baseline.raw.get(series.START) or range(len(self._both)), np.float64)
        self._places = {key: self._of(row, key).astype(int) for key in AGAINST if key in row.raw}
        titles = {series.TASK: tables.BY_TASK, series.INSTRUCTION: tables.BY_INSTRUCTION}
        self._names = {key: [str(record[key]) for record in row.details[titles[key]]] for key in self._places}
        self._metrics = sorted(series.METRIC.among(name for name in row.raw if name in baseline.raw))

    def ratios(self) -> Iterator[tuple[str, Ratio]]:
        """Yield the ratio of each metric in the episodes in which both succeed, the worst task named."""
        for name in self._metrics:
            own, base, known = self._values(name)
            if not known.any() or not (own[known].any() or base[known].any()):
                continue
            if (ratio := self._ratio_of(own, base, known, self._confidence)) is None:
                continue
            counted, *unknown = self._counted(known)
            note = (f"of the means of {counted}", *unknown, *self._worst_of(own, base, known))
            starts = distinct_starts(self._starts[known].tolist())
            few = Doubt(Cause.FEW_STARTS, starts) if starts < min(MIN_PAIRS, known.sum()) else None
            doubt = self.doubt(name) or few
            yield name, _ratio(RATIO.quantity(name), ratio, int(known.sum()), note, self._confidence, doubt)

    def doubt(self, name: str) -> Doubt | None:
        """Return why the values of a metric that are missing leave nothing to be claimed of it; None where they do."""
        own, base, _ = (np.isfinite(values) for values in self._values(name))
        total = int(self._both.sum())
        ours, theirs = (int((self._both & ~one & other).sum()) for one, other in ((own, base), (base, own)))
        known = int((self._both & own & base).sum())
        if total and known < MIN_KNOWN_SHARE * total:
            return Doubt(Cause.RARELY_KNOWN, known, total)
        if ours > theirs and sign_test(ours, ours + theirs) <= DOUBT:
            return Doubt(Cause.MISSING_MORE_OFTEN, ours, theirs)
        return None

    def _counted(self, known: NDArray[np.bool_]) -> tuple[str, ...]:
        """Return the episodes of a ratio in words, and in how many a metric is unknown."""
        some, total = int(known.sum()), int(self._both.sum())
        if some == total:
            return (f"{some} episodes in which both succeed",)
        return f"{some} of {total} episodes in which both succeed", f"unknown in {total - some} of them"

    def _ratio_of(
        self, own: Array, base: Array, known: NDArray[np.bool_], confidence: float = CONFIDENCE
    ) -> tuple[float, float, float] | None:
        """Return the ratio of means; episodes that begin alike are one of the things that are drawn again."""
        places = np.unique(self._starts[known], return_inverse=True)[1]
        ours, theirs = (np.bincount(places, values[known]).astype(np.float64) for values in (own, base))
        return ratio_of(ours, theirs, confidence)

    def above_none(self) -> Iterator[tuple[str, tuple[int, int]]]:
        """Yield each metric that the baseline has nothing of where both succeed, and the pairs with some, and all."""
        for name in self._metrics:
            own, base, known = self._values(name)
            if known.any() and not base[known].any():
                starts = self._starts[known]
                yield name, (distinct_starts(starts[own[known] > 0].tolist()), distinct_starts(starts.tolist()))

    def added_motion(self) -> Iterator[Measurement]:
        """Yield the mean of each of these metrics that the variant has something of."""
        for name, (some, _) in self.above_none():
            if some:
                own, _, known = self._values(name)
                some, count = int((own[known] > 0).sum()), int(known.sum())
                note = f"mean of {'; '.join(self._counted(known))}: above 0 in {some} of them, and in none of the "
                quantity = ADDED_MEAN.quantity(name, metrics()[name].unit)
                yield quantity.measurement(float(own[known].mean()), samples=count, note=f"{note}baseline's")

    def steps(self) -> Iterator[Measurement]:
        """Yield the ratio of the steps of all episodes; one that fails counts as long as the longest of its task."""
        steps = [self._of(one, series.STEPS) for one in self._rows]
        if series.TASK not in self._places:
            return
        longest = np.zeros(len(steps[0]))
        for index in range(len(self._names[series.TASK])):
            own = self._places[series.TASK] == index
            longest[own] = max(one[own].max() for one in steps)
        base, own = (np.where(won, one, longest) for won, one in zip(self._wins, steps, strict=True))
        if ratio := self._ratio_of(own, base, np.ones(len(own), bool)):
            what = "steps of all episodes, failures at full length"
            yield _ratio(STEPS_RATIO, ratio, len(own), (what,), CONFIDENCE).measured

    def worst(self) -> Iterator[Measurement]:
        """Yield the drop of the task that loses most, with an interval that allows for the choice."""
        drops = self.drops()
        if len(drops) > 1:
            name = max(drops, key=lambda task: drops[task].value)
            yield replace(drops[name], note=f"{name}{WORST_TASK_PREFIX}{len(drops)} tasks")

    def drops(self) -> dict[str, Measurement]:
        """Return task -> its drop; all intervals together have the coverage of the pairs (Bonferroni)."""
        names = self._names.get(series.TASK, [])
        confidence = 1 - (1 - self._confidence) / max(1, len(names))
        drops = {}
        for index, name in enumerate(names):
            (value, low, high), count = self._drop(self._places[series.TASK] == index, confidence)
            drops[name] = WORST_TASK_DROP.measurement(
                value, samples=count, low=low, high=high, confidence=confidence, note=name
            )
        return drops

    def table(self, key: str) -> list[dict[str, Any]]:
        """Return how each task, or instruction, does and moves, that which loses most first."""
        records = []
        for index, name in enumerate(self._names.get(key, ())):
            own = self._places[key] == index
            (value, low, high), count = self._drop(own, self._confidence)
            before, after = (float(won[own].mean()) for won in self._wins)
            record: dict[str, Any] = {
                key: name,
                "episodes": count,
                "baseline": round(before, 4),
                "success": round(after, 4),
            }
            record |= {"drop": round(value, 4), "low": round(low, 4), "high": round(high, 4)}
            records.append(record | self._ratios_of(own))
        return sorted(records, key=lambda record: -record["drop"])[:LONGEST] if len(records) > 1 else []

    def _ratios_of(self, chosen: NDArray[np.bool_]) -> dict[str, Any]:
        """Return metric -> ratio among some episodes; nothing where both succeed in fewer than ``MIN_PAIRS``."""
        ratios: dict[str, Any] = {}
        for name in self._metrics:
            own, base, known = self._values(name)
            known = known & chosen
            enough = known.sum() >= MIN_PAIRS and (own[known].any() or base[known].any())
            if enough and (ratio := self._ratio_of(own, base, known)):
                ratios[f"{name.replace('_', ' ')}, x"] = round(ratio[0], 3)
        return ratios

    def _worst_of(self, own: Array, base: Array, known: NDArray[np.bool_]) -> Iterator[str]:
        """Yield the task whose ratio is the largest, as a part of a note, where there are several tasks."""
        ratios = []
        for index, name in enumerate(self._names.get(series.TASK, ())):
            chosen = known & (self._places[series.TASK] == index)
            if chosen.sum() >= MIN_PAIRS and base[chosen].mean() > 0:
                ratios.append((float(own[chosen].mean() / base[chosen].mean()), name))
        if len(ratios) > 1:
            yield f"most in {max(ratios)[1]}: {max(ratios)[0]:.3g}x"

    def _drop(self, chosen: NDArray[np.bool_], confidence: float) -> tuple[tuple[float, float, float], int]:
        before, after = (won[chosen] for won in self._wins)
        lost, won = int((before & ~after).sum()), int((after & ~before).sum())
        size = independent_starts(self._starts[chosen].tolist())
        return exact_drop(lost, won, len(before), confidence, size), len(before)

    def _values(self, name: str) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return a metric of the variant and of the baseline, NaN where one is missing, and where both are known.

        A number that is by the rate of the spec, since the environment's clock went wrong in that episode, is missing
        where the other one is by the clock.
        """
        missing = [math.nan] * len(self._both)
        base, own = (np.array(one.raw.get(series.METRIC.name(name), missing), np.float64) for one in self._rows)
        clocks = [np.asarray(one.raw.get(series.NO_CLOCK) or np.zeros(len(self._both))) > 0 for one in self._rows]
        base[clocks[0] & ~clocks[1]] = own[clocks[1] & ~clocks[0]] = math.nan
        return own, base, self._both & np.isfinite(own) & np.isfinite(base)

    @staticmethod
    def _of(row: Row, name: str) -> Array:
        return np.asarray(row.raw[name], np.float64)
