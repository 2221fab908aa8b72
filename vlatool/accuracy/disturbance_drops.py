"""Cost of disturbances: the same episodes of a variant and of its baseline under each of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from vlatool.accuracy.success_comparison import Outcome, compare_success, success_row
from vlatool.measures import series, tables
from vlatool.measures.motion import RATIO, STEPS_RATIO
from vlatool.measures.success import DISTURBED_DROP, SUCCESS, SUCCESS_DISTURBED, SUCCESS_DROP
from vlatool.report import Measurement, Row
from vlatool.stats.intervals import wilson
from vlatool.stats.starts import independent_starts
from vlatool.stats.success_sequential import exact_drop

Played = Sequence[Outcome]
Disturbance = tuple[str, float]
"""Kind and strength."""
TABLE_METRICS = {"task_time": "task time", "path_length": "path", "jerk": "jerk", "action_rate": "action rate"}
"""Metrics of motion that the table has, where both succeed."""


def with_disturbed(
    row: Row, played: Mapping[Disturbance, Played], reference: Mapping[Disturbance, Played] | None
) -> Row:
    """Return the row with how it does under each disturbance, the worst kind first, and its strengths in their order.

    Args:
        row: row of the variant, undisturbed.
        played: Disturbance -> episodes of the variant.
        reference: the same of the baseline; None without one.
    """
    records, raw = [], dict[str, list[float]]()
    wins = count = 0
    kinds = dict.fromkeys(kind for kind, _ in played)
    strengths = dict.fromkeys(strength for _, strength in played)
    for (kind, strength), own in played.items():
        name = f"{kind} at {strength:g}" if len(strengths) > 1 else kind
        base = reference[kind, strength] if reference else None
        disturbed = success_row(kind, "subject", own)
        if base is not None:
            disturbed = compare_success(success_row("baseline", "baseline", base), disturbed)
            raw[series.DISTURBED_BASELINE.name(name)] = [float(outcome.success) for outcome in base]
        raw[series.DISTURBED_SUCCESS.name(name)] = disturbed.raw[series.SUCCESS]
        wins, count = wins + int(sum(disturbed.raw[series.SUCCESS])), count + len(own)
        records.append(_record(kind, strength, disturbed, base))
    first = sorted(records, key=_badness)
    order = list(dict.fromkeys(record["disturbance"] for record in first))
    records.sort(key=lambda record: (order.index(record["disturbance"]), record["strength"]))
    low, high = wilson(wins, count)
    listed = ", ".join(f"{strength:g}" for strength in strengths)
    note = f"under {', '.join(kinds)}; strength {listed}"
    rate = SUCCESS_DISTURBED.measurement(wins / count, samples=count, low=low, high=high, note=note)
    measurements, details = (*row.measurements, rate), {**row.details, tables.UNDER: records}
    return replace(row, measurements=measurements, raw={**row.raw, **raw}, details=details)


def without_effect(name: str, played: Mapping[Disturbance, Played], undisturbed: Played) -> Iterator[str]:
    """Yield a warning for each disturbance that changed nothing, so that what is kept under it shows nothing.

    Args:
        played: disturbance -> its episodes, seed by seed.
        undisturbed: episodes of the same seeds without a disturbance.
    """
    for (kind, strength), outcomes in played.items():
        if strength and list(map(_course, outcomes)) == list(map(_course, undisturbed)):
            yield (
                f"under {kind}, strength {strength:g}, all {len(outcomes)} episodes of {name} went as without it, step "
                "for step, so that they do not show what it costs; see that it changes what the policy is given"
            )


def _course(outcome: Outcome) -> tuple[Any, ...]:
    """Return what tells two episodes of a seed apart."""
    return outcome.task, outcome.seed, outcome.success, outcome.steps, outcome.start, dict(outcome.motion)


def worst_record(row: Row) -> tuple[Mapping[str, Any], str] | None:
    """Return the line of the table under which most is lost, and its disturbance in words; None without a table."""
    table = row.details.get(tables.UNDER)
    if not table:
        return None
    worst = min(table, key=_badness)
    several = len({record["strength"] for record in table}) > 1
    strength = f" at strength {worst['strength']:g}" if several else ""
    return worst, f"{worst['disturbance']}{strength}"


def _badness(record: Mapping[str, Any]) -> tuple[float, float]:
    """Return what sorts the disturbance first under which most is lost."""
    return -record.get("drop", 0.0), record["success"]


def drops_by_disturbance(row: Row, confidence: float = 0.95) -> dict[str, Measurement]:
    """Return disturbance -> how many more episodes fail than of the baseline, each with an interval.

    Args:
        row: row from ``with_disturbed``; disturbances that have no reference are left out.
        confidence: coverage of all intervals together (Bonferroni).
    """
    drops = {}
    kinds = [
        kind for kind in series.DISTURBED_SUCCESS.among(row.raw) if series.DISTURBED_BASELINE.name(kind) in row.raw
    ]
    confidence = 1 - (1 - confidence) / max(1, len(kinds))
    for kind in kinds:
        names = series.DISTURBED_BASELINE.name(kind), series.DISTURBED_SUCCESS.name(kind)
        pairs = list(zip(*(row.raw[name] for name in names), strict=True))
        lost, won = sum(before > after for before, after in pairs), sum(before < after for before, after in pairs)
        size = independent_starts(row.raw.get(series.START) or range(len(pairs)))
        drop, low, high = exact_drop(lost, won, len(pairs), confidence, size)
        drops[kind] = DISTURBED_DROP.measurement(
            drop, samples=len(pairs), low=low, high=high, confidence=confidence, note=kind
        )
    return drops


def _record(kind: str, strength: float, row: Row, base: Sequence[Outcome] | None) -> dict[str, Any]:
    record: dict[str, Any] = {"disturbance": kind, "strength": strength, "episodes": len(row.raw[series.SUCCESS])}
    if base is not None:
        record["baseline"] = round(sum(outcome.success for outcome in base) / len(base), 4)
    record["success"] = round(row.value(SUCCESS), 4)
    if drop := row.get(SUCCESS_DROP):
        record |= {"drop": round(drop.value, 4), "low": round(drop.low or 0.0, 4), "high": round(drop.high or 0.0, 4)}
    ratios = {"steps": STEPS_RATIO, **{words: RATIO.quantity(name) for name, words in TABLE_METRICS.items()}}
    return record | {f"{words}, x": round(ratio.value, 3) for words, one in ratios.items() if (ratio := row.get(one))}
