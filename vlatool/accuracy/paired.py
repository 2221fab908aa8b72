"""Rows of a report from episode outcomes, and the paired comparison of two rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from vlatool.errors import DataError
from vlatool.report import Measurement, Row
from vlatool.stats.intervals import mcnemar_exact, paired_drop, wilson


@dataclass(frozen=True)
class Outcome:
    """How one episode ended: after ``steps`` control steps."""

    task: str
    seed: int
    success: bool
    steps: int


def success_row(name: str, role: str, outcomes: Sequence[Outcome]) -> Row:
    """Return the success rate with its Wilson interval, a row for each task, and every outcome."""
    wins = sum(outcome.success for outcome in outcomes)
    low, high = wilson(wins, len(outcomes))
    note = "closed loop, Wilson interval"
    rate = Measurement("success", wins / len(outcomes), "1", samples=len(outcomes), low=low, high=high, note=note)
    raw = {
        "success": [float(outcome.success) for outcome in outcomes],
        "seed": [float(outcome.seed) for outcome in outcomes],
        "steps": [float(outcome.steps) for outcome in outcomes],
    }
    return Row(name, role, measurements=(rate,), raw=raw, details={"success by task": _by_task(outcomes)})


def _by_task(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    table = []
    for task in dict.fromkeys(outcome.task for outcome in outcomes):
        own = [outcome for outcome in outcomes if outcome.task == task]
        wins = sum(outcome.success for outcome in own)
        low, high = wilson(wins, len(own))
        steps = sum(outcome.steps for outcome in own) / len(own)
        cells = {"task": task, "success": round(wins / len(own), 4), "low": round(low, 4), "high": round(high, 4)}
        table.append({**cells, "episodes": len(own), "mean steps": round(steps, 1)})
    return table


def with_chance(reference: Row, controls: Sequence[Row]) -> Row:
    """Return the row with ``success_chance``: how often the better control succeeds, with its Wilson interval."""
    rates = [(row.name, rate) for row in controls if (rate := row.get("success")) is not None]
    name, best = max(rates, key=lambda pair: pair[1].value)
    note = f"{name} actions, the better of {' and '.join(name for name, _ in rates)}"
    chance = replace(best, name="success_chance", note=note)
    return replace(reference, measurements=(*reference.measurements, chance))


def compare_success(baseline: Row, row: Row) -> Row:
    """Return the row with ``success_drop`` and McNemar's exact test, episode by episode.

    Raises:
        DataError: when the two rows did not play the same seeds.
    """
    if baseline.raw["seed"] != row.raw["seed"]:
        raise DataError("The two evaluations did not play the same episodes, so they cannot be paired.")
    pairs = list(zip(baseline.raw["success"], row.raw["success"], strict=True))
    lost = sum(before > after for before, after in pairs)
    won = sum(before < after for before, after in pairs)
    drop, low, high = paired_drop(lost, won, len(pairs))
    p = mcnemar_exact(lost, won)
    test = Measurement("mcnemar_p", p, "1", samples=len(pairs), note="exact, two-sided")
    note = f"paired: {lost} lost, {won} won of {len(pairs)} episodes"
    difference = Measurement("success_drop", drop, "1", samples=len(pairs), low=low, high=high, note=note)
    table = [{"episodes": len(pairs), "lost": lost, "won": won, "drop": round(drop, 4), "McNemar exact p": round(p, 4)}]
    details = {**row.details, "paired with the baseline": table}
    return replace(row, measurements=(*row.measurements, difference, test), details=details)
