"""Rows of a report from episode outcomes, and the paired comparison of two rows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from vlatool.accuracy.doubt import Cause, Doubt
from vlatool.accuracy.motion_comparison import compare_motion
from vlatool.errors import DataError
from vlatool.files.printable import amount
from vlatool.measures import series, tables
from vlatool.measures.motion import mean_of
from vlatool.measures.success import MCNEMAR_P, SUCCESS, SUCCESS_CHANCE, SUCCESS_DROP
from vlatool.motion.measure import metrics
from vlatool.report import Measurement, Row
from vlatool.stats.intervals import mcnemar_exact
from vlatool.stats.starts import distinct_starts, has_too_few_starts, independent_starts, wilson_of
from vlatool.stats.success_sequential import exact_drop

CLOCK = "time"
"""Key of the environment's clock in the info of a step."""
MOST_INSTRUCTIONS = 64
"""Wordings up to which each has a line in a table."""


@dataclass(frozen=True)
class Outcome:
    """How one episode ended.

    Args:
        steps: control steps that it took.
        instruction: instruction of the policy; empty for one that takes no text.
        motion: metric of motion -> its value.
        refused: numbers of the robot's body that the environment gave and that could not be used -> why.
        series: values of each step to be shown: ``position.x``, ``action.NAME``, ``fresh``.
        start: hash of the first observation; empty where it is not known.
    """

    task: str
    seed: int
    success: bool
    steps: int
    instruction: str = ""
    motion: Mapping[str, float] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)
    series: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    start: str = ""

    @property
    def begins(self) -> tuple[str, str | int]:
        """Identity that episodes with the same beginning share; one whose start is not known begins as no other."""
        return self.task, self.start or self.seed


def success_row(name: str, role: str, outcomes: Sequence[Outcome]) -> Row:
    """Return the success rate with its Wilson interval, how it moves, tables by task and instruction, all outcomes."""
    wins = sum(outcome.success for outcome in outcomes)
    starts = _numbered([outcome.begins for outcome in outcomes])
    low, high = wilson_of(wins, starts)
    note = f"closed loop, Wilson interval; {_starts(starts)}"
    rate = SUCCESS.measurement(wins / len(outcomes), samples=len(outcomes), low=low, high=high, note=note)
    tasks = _table("task", outcomes, lambda outcome: outcome.task)
    told = sorted({outcome.instruction for outcome in outcomes})
    raw = {
        series.SUCCESS: [float(outcome.success) for outcome in outcomes],
        series.SEED: [float(outcome.seed) for outcome in outcomes],
        series.STEPS: [float(outcome.steps) for outcome in outcomes],
        series.TASK: _places(tasks, "task", [outcome.task for outcome in outcomes]),
        series.START: starts,
    }
    raw |= {series.METRIC.name(name): [outcome.motion.get(name, math.nan) for outcome in outcomes]
            for name in metrics() if any(name in outcome.motion for outcome in outcomes)}  # fmt: skip
    if any(CLOCK in outcome.refused for outcome in outcomes):
        raw[series.NO_CLOCK] = [float(CLOCK in outcome.refused) for outcome in outcomes]
    details = {tables.BY_TASK: tasks}
    if 1 < len(told) <= MOST_INSTRUCTIONS:
        details[tables.BY_INSTRUCTION] = _table("instruction", outcomes, lambda outcome: outcome.instruction)
        asked = [outcome.instruction for outcome in outcomes]
        raw[series.INSTRUCTION] = _places(details[tables.BY_INSTRUCTION], "instruction", asked)
    if refused := list(_refused(outcomes)):
        details[tables.MISSING_VALUES] = refused
    return Row(name, role, measurements=(rate, *_moved(outcomes)), raw=raw, details=details)


def _numbered(starts: Sequence[Hashable]) -> list[float]:
    """Return a number for each start, the same for equal ones."""
    numbers = {start: float(number) for number, start in enumerate(dict.fromkeys(starts))}
    return [numbers[start] for start in starts]


def _starts(starts: Sequence[Hashable]) -> str:
    count, worth = distinct_starts(starts), independent_starts(starts)
    return f"{count} distinct starts" + (f", worth {amount(worth, 'episode')}" if worth < len(starts) else "")


def few_starts(row: Row) -> Doubt | None:
    """Return why episodes decide nothing: they repeat their first observations, and have too few; None otherwise."""
    starts = row.raw.get(series.START, [])
    return Doubt(Cause.REPEATED_STARTS, distinct_starts(starts), len(starts)) if has_too_few_starts(starts) else None


def repeated_starts(row: Row) -> tuple[str, ...]:
    """Return a sentence where episodes begin alike, so that they say less than their number promises."""
    starts = row.raw.get(series.START, [])
    count, size = distinct_starts(starts), independent_starts(starts)
    if count == len(starts):
        return ()
    return (
        f"the {amount(len(starts), 'episode')} have {count} distinct first observations, so that they count as "
        f"{size}: let reset(seed=...) draw each episode anew, and show it in the first observation",
    )


def _moved(outcomes: Sequence[Outcome]) -> Iterator[Measurement]:
    """Yield the mean of each metric over the episodes that succeed."""
    for name, metric in metrics().items():
        values = [outcome.motion[name] for outcome in outcomes if outcome.success and name in outcome.motion]
        if values and any(values):
            mean = math.fsum(values) / len(values)
            note = "mean of the episodes that succeed"
            yield mean_of(name, metric.unit).measurement(mean, samples=len(values), note=note)


def _refused(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Yield what environments told of the body and could not be used, with the most frequent reason."""
    reasons = Counter((name, why) for outcome in outcomes for name, why in outcome.refused.items())
    for name in dict.fromkeys(name for name, _ in reasons):
        episodes = sum(name in outcome.refused for outcome in outcomes)
        why = max((reason for reason in reasons if reason[0] == name), key=reasons.__getitem__)[1]
        yield {
            "what": f"motion from info['{name}']",
            "why": f"{why} ({episodes} of {amount(len(outcomes), 'episode')})",
        }


def _places(table: list[dict[str, Any]], column: str, values: Sequence[str]) -> list[float]:
    """Return the index of each value in a table."""
    places = {record[column]: float(index) for index, record in enumerate(table)}
    return [places[value] for value in values]


def _table(column: str, outcomes: Sequence[Outcome], key: Callable[[Outcome], str]) -> list[dict[str, Any]]:
    table = []
    for value in dict.fromkeys(map(key, outcomes)):
        own = [outcome for outcome in outcomes if key(outcome) == value]
        wins = sum(outcome.success for outcome in own)
        starts = [outcome.begins for outcome in own]
        low, high = wilson_of(wins, starts)
        steps = sum(outcome.steps for outcome in own) / len(own)
        cells = {column: value, "success": round(wins / len(own), 4), "low": round(low, 4), "high": round(high, 4)}
        cells |= {"episodes": len(own), "distinct starts": distinct_starts(starts), "mean steps": round(steps, 1)}
        table.append(cells)
    return table


def with_chance(reference: Row, controls: Sequence[Row]) -> Row:
    """Return the row with ``success_chance``: how often the better control succeeds, with its Wilson interval."""
    rates = [(row.name, rate) for row in controls if (rate := row.get(SUCCESS)) is not None]
    name, best = max(rates, key=lambda pair: pair[1].value)
    note = f"{name} actions, the better of {' and '.join(name for name, _ in rates)}"
    return replace(reference, measurements=(*reference.measurements, SUCCESS_CHANCE.relabel(best, note)))


def compare_success(baseline: Row, row: Row) -> Row:
    """Return the row with ``success_drop`` and McNemar's exact test, episode by episode.

    Raises:
        DataError: when the two rows did not play the same seeds.
    """
    if baseline.raw[series.SEED] != row.raw[series.SEED]:
        raise DataError(
            "The two evaluations did not play the same episodes, so they cannot be paired.",
            "play both again with the same --episodes and tasks",
        )
    pairs = list(zip(baseline.raw[series.SUCCESS], row.raw[series.SUCCESS], strict=True))
    lost = sum(before > after for before, after in pairs)
    won = sum(before < after for before, after in pairs)
    starts = baseline.raw[series.START]
    size = independent_starts(starts)
    drop, low, high = exact_drop(lost, won, len(pairs), size=size)
    p = mcnemar_exact(*(count * size // len(pairs) for count in (lost, won)))
    test = MCNEMAR_P.measurement(p, samples=len(pairs), note="exact, two-sided")
    note = f"paired: {lost} lost, {won} won of {amount(len(pairs), 'episode')}; {_starts(starts)}"
    difference = SUCCESS_DROP.measurement(drop, samples=len(pairs), low=low, high=high, note=note)
    table = [{"episodes": len(pairs), "lost": lost, "won": won, "drop": round(drop, 4), "McNemar exact p": round(p, 4)}]
    details = {**row.details, tables.PAIRED_SUCCESS: table}
    row = replace(row, measurements=(*row.measurements, difference, test), details=details)
    return compare_motion(baseline, row)
