"""How a variant moves, beside what it is held against: in the episodes in which both succeed, and by task."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.motion.measure import MIN_PAIRS, metrics, ratio_of
from vlatool.report import NO_INTERVAL, Measurement, Row
from vlatool.stats.intervals import sign_test
from vlatool.stats.starts import distinct_starts, independent_starts
from vlatool.stats.success_sequential import exact_drop

Array = NDArray[np.float64]
MOTION = "motion."
"""What the names of raw samples begin with that a metric of motion gave."""
RATIO = "_ratio"
ADDED = "_added"
"""What the name of a metric ends with where the baseline's is 0 in every pair, so that there is no ratio."""
STEPS = "steps_ratio"
WORST = "worst_task_drop"
SPEEDUP = "task_speedup"
BY_TASK, BY_INSTRUCTION = "success by task", "success by instruction"
AGAINST = {"task": "against the baseline, by task", "instruction": "against the baseline, by instruction"}
CONFIDENCE = 0.95
NO_CLOCK = "no clock"
"""The raw samples that say in which episodes the environment's clock could not be used."""
START = "start"
"""The raw samples that number the distinct first observations of episodes."""
KNOWN = 0.9
"""Share of the episodes in which both succeed that must tell a metric of both, or nothing is claimed of it."""
DOUBT = 0.25
"""Chance below which it is no accident that the variant's values are missing more often (an exact sign test): the doubt
is not the baseline's, so that two episodes suffice."""
LONGEST = 20
"""Tasks, or instructions, of a table: those that lose most."""


def compare_motion(baseline: Row, row: Row) -> Row:
    """Return the row with how it moves as a multiple of the baseline, its worst task, and both by task.

    Args:
        baseline, row: Of ``success_row``, of the same episodes.
    """
    pairs = _Pairs(baseline, row)
    tables = {title: table for key, title in AGAINST.items() if (table := pairs.table(key))}
    found = (*pairs.ratios(), *pairs.added(), *pairs.steps(), *pairs.worst())
    return replace(row, measurements=(*row.measurements, *found), details={**row.details, **tables})


def ratios(baseline: Row, row: Row, names: Collection[str], confidence: float = CONFIDENCE) -> dict[str, Measurement]:
    """Return ``METRIC_ratio`` -> how a variant moves as a multiple of the baseline, in episodes in which both succeed.

    Args:
        baseline, row: Of ``success_row``, of the same episodes.
        names: Metrics; those that the episodes do not have are left out.
        confidence: Coverage of each interval.
    """
    found = _Pairs(baseline, row, confidence).ratios()
    return {item.name: item for item in found if item.name.removesuffix(RATIO) in names}


def doubts(baseline: Row, row: Row, names: Collection[str]) -> dict[str, str]:
    """Return metric -> why its missing values leave nothing to be claimed of it; those that are known are left out.

    Args:
        baseline, row: Of ``success_row``, of the same episodes.
        names: Metrics; those that the baseline's episodes do not have are left out.
    """
    pairs, known = _Pairs(baseline, row), known_of(baseline)
    return {name: why for name in names if name in known and (why := pairs.doubt(name))}


def known_of(baseline: Row) -> list[str]:
    """Return the metrics that episodes of the baseline have in which it succeeds, whatever a variant has."""
    won = np.asarray(baseline.raw["success"]) > 0
    values = {name.removeprefix(MOTION): values for name, values in baseline.raw.items() if name.startswith(MOTION)}
    return sorted(name for name, own in values.items() if np.isfinite(np.asarray(own, np.float64)[won]).any())


def pairs_above_none(baseline: Row, row: Row, names: Collection[str]) -> dict[str, tuple[int, int]]:
    """Return metric -> in how many of the episodes in which both succeed a variant has any, and of how many.

    Args:
        baseline, row: Of ``success_row``, of the same episodes.
        names: Metrics; those of which the baseline has some, or that the episodes do not have, are left out.
    """
    return {name: counts for name, counts in _Pairs(baseline, row).above_none() if name in names}


def drops_by_task(baseline: Row, row: Row, confidence: float = CONFIDENCE) -> dict[str, Measurement]:
    """Return task -> how many more of its episodes fail, a share, with intervals of a joint coverage (Bonferroni)."""
    return _Pairs(baseline, row, confidence).drops()


def with_task_speedup(row: Row) -> Row:
    """Return the row with how many times as fast it does its task: its speed-up by the ratio of its steps.

    A policy that answers in half of the time and needs twice as many steps is done no sooner, where the control loop
    waits for its answers.
    """
    speed, steps = row.get("speedup"), row.get(STEPS)
    if speed is None or steps is None or not steps.value or None in (speed.low, speed.high, steps.low, steps.high):
        return row
    low, high = (speed.low or 0.0) / max(steps.high or 0.0, 1e-9), (speed.high or 0.0) / max(steps.low or 0.0, 1e-9)
    note = "speed-up of an inference / ratio of steps, failures at full length"
    task = Measurement(SPEEDUP, speed.value / steps.value, "x", samples=steps.samples, low=low, high=high, note=note)
    return replace(row, measurements=(*row.measurements, task))


def _ratio(
    name: str, ratio: tuple[float, float, float], count: int, note: str, confidence: float, doubt: str = ""
) -> Measurement:
    value, low, high = ratio
    if np.isfinite(high) and not doubt:
        return Measurement(name, value, "x", samples=count, low=low, high=high, confidence=confidence, note=note)
    zeros = "too few pairs in which the baseline's is not 0"  # resamples have none of them, and no ratio
    why = doubt or (f"{count} pairs, and it takes {MIN_PAIRS}" if count < MIN_PAIRS else zeros)
    first, _, rest = note.partition("; ")
    parts = (first, f"{NO_INTERVAL}{why}", *([rest] if rest else []))
    return Measurement(name, value, "x", samples=count, confidence=confidence, note="; ".join(parts))


class _Pairs:
    """Two rows, episode by episode."""

    def __init__(self, baseline: Row, row: Row, confidence: float = CONFIDENCE) -> None:
        self._rows, self._confidence = (baseline, row), confidence
        self._wins = tuple(self._of(one, "success") > 0 for one in self._rows)
        self._both = self._wins[0] & self._wins[1]
        self._starts = np.asarray(baseline.raw.get(START) or range(len(self._both)), np.float64)
        self._places = {key: self._of(row, key).astype(int) for key in AGAINST if key in row.raw}
        titles = {"task": BY_TASK, "instruction": BY_INSTRUCTION}
        self._names = {key: [str(record[key]) for record in row.details[titles[key]]] for key in self._places}
        self._metrics = sorted(
            name.removeprefix(MOTION) for name in row.raw if name.startswith(MOTION) and name in baseline.raw
        )

    def ratios(self) -> Iterator[Measurement]:
        """Yield the ratio of each metric in the episodes in which both succeed, the worst task named."""
        for name in self._metrics:
            own, base, known = self._values(name)
            if not known.any() or not (own[known].any() or base[known].any()):
                continue
            if (ratio := self._ratio_of(own, base, known, self._confidence)) is None:
                continue
            note = f"of the means of {self._told(known)}{self._worst_of(own, base, known)}"
            starts = distinct_starts(self._starts[known].tolist())
            why = f"{starts} distinct starts, and it takes {MIN_PAIRS}" if starts < min(MIN_PAIRS, known.sum()) else ""
            doubt = self.doubt(name) or why
            yield _ratio(f"{name}{RATIO}", ratio, int(known.sum()), note, self._confidence, doubt)

    def doubt(self, name: str) -> str:
        """Return why the values of a metric that are missing leave nothing to be claimed of it; empty where they do."""
        own, base, _ = (np.isfinite(values) for values in self._values(name))
        total = int(self._both.sum())
        ours, theirs = (int((self._both & ~one & other).sum()) for one, other in ((own, base), (base, own)))
        known = int((self._both & own & base).sum())
        if total and known < KNOWN * total:
            return f"known of both in {known} of {total} common successes, and it takes {KNOWN:.0%}"
        if ours > theirs and sign_test(ours, ours + theirs) <= DOUBT:
            return f"missing in {ours} common successes where the baseline has it, the other way round in {theirs}"
        return ""

    def _told(self, known: NDArray[np.bool_]) -> str:
        some, total = int(known.sum()), int(self._both.sum())
        return f"{some} episodes in which both succeed" if some == total else (
            f"{some} of {total} episodes in which both succeed; unknown in {total - some} of them")  # fmt: skip

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

    def added(self) -> Iterator[Measurement]:
        """Yield the mean of each of these metrics that the variant has something of."""
        for name, (some, _) in self.above_none():
            if some:
                own, _, known = self._values(name)
                some, count = int((own[known] > 0).sum()), int(known.sum())
                note = f"mean of {self._told(known)}: above 0 in {some} of them, and in none of the "
                yield Measurement(f"{name}{ADDED}", float(own[known].mean()), metrics()[name].unit, samples=count,
                                  note=f"{note}baseline's")  # fmt: skip

    def steps(self) -> Iterator[Measurement]:
        """Yield the ratio of the steps of all episodes; one that fails counts as long as the longest of its task."""
        steps = [self._of(one, "steps") for one in self._rows]
        if "task" not in self._places:
            return
        longest = np.zeros(len(steps[0]))
        for place in range(len(self._names["task"])):
            own = self._places["task"] == place
            longest[own] = max(one[own].max() for one in steps)
        base, own = (np.where(won, one, longest) for won, one in zip(self._wins, steps, strict=True))
        if ratio := self._ratio_of(own, base, np.ones(len(own), bool)):
            yield _ratio(STEPS, ratio, len(own), "steps of all episodes, failures at full length", CONFIDENCE)

    def worst(self) -> Iterator[Measurement]:
        """Yield the drop of the task that loses most, with an interval that allows for the choice."""
        drops = self.drops()
        if len(drops) > 1:
            name = max(drops, key=lambda task: drops[task].value)
            yield replace(drops[name], note=f"{name}, the worst of {len(drops)} tasks")

    def drops(self) -> dict[str, Measurement]:
        """Return task -> its drop; all intervals together have the coverage of the pairs (Bonferroni)."""
        names = self._names.get("task", [])
        confidence = 1 - (1 - self._confidence) / max(1, len(names))
        drops = {}
        for place, name in enumerate(names):
            (value, low, high), count = self._drop(self._places["task"] == place, confidence)
            drops[name] = Measurement(WORST, value, "1", samples=count, low=low, high=high, confidence=confidence,
                                      note=name)  # fmt: skip
        return drops

    def table(self, key: str) -> list[dict[str, Any]]:
        """Return how each task, or instruction, does and moves, that which loses most first."""
        records = []
        for place, name in enumerate(self._names.get(key, ())):
            own = self._places[key] == place
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

    def _worst_of(self, own: Array, base: Array, known: NDArray[np.bool_]) -> str:
        """Return the task whose ratio is the largest, as a part of a note; empty where there is one task alone."""
        ratios = []
        for place, name in enumerate(self._names.get("task", ())):
            chosen = known & (self._places["task"] == place)
            if chosen.sum() >= MIN_PAIRS and base[chosen].mean() > 0:
                ratios.append((float(own[chosen].mean() / base[chosen].mean()), name))
        return f"; most in {max(ratios)[1]}: {max(ratios)[0]:.3g}x" if len(ratios) > 1 else ""

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
        base, own = (np.array(one.raw.get(f"{MOTION}{name}", missing), np.float64) for one in self._rows)
        clocks = [np.asarray(one.raw.get(NO_CLOCK) or np.zeros(len(self._both))) > 0 for one in self._rows]
        base[clocks[0] & ~clocks[1]] = own[clocks[1] & ~clocks[0]] = math.nan
        return own, base, self._both & np.isfinite(own) & np.isfinite(base)

    @staticmethod
    def _of(row: Row, name: str) -> Array:
        return np.asarray(row.raw[name], np.float64)
