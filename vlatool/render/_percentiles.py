"""The percentiles of the latency as one table: a percentile a row, a value and its bound for each variant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from vlatool.render._format import count, decimals_of, fixed, interval, number, plain
from vlatool.render._view import percentile_names
from vlatool.report import Measurement, Report

NOTHING = "–"


@dataclass(frozen=True)
class Percentiles:
    """One column for each variant that has percentiles.

    Args:
        names: The percentiles, ``p50`` … ``max``.
        variants: Names of the variants.
        values: By percentile and variant; ``–`` when it could not be had.
        bounds: By percentile and variant; empty when there is none.
        reasons: By percentile and variant: why it could not be had.
        bound: What the bounds are, as a column title: ``at most (99 %)``.
        counts: For each variant, the number of calls.
        what: What is counted: ``calls``, or the ``ticks`` of a control loop.
    """

    names: list[str]
    variants: list[str]
    values: list[list[str]]
    bounds: list[list[str]]
    reasons: list[list[str]]
    bound: str
    counts: list[str]
    what: str = "calls"

    @property
    def bounded(self) -> bool:
        """Whether any percentile has a bound."""
        return any(any(line) for line in self.bounds)

    def beside(self) -> list[list[str]]:
        """Return ``41.3 ≤ 42.0`` for each percentile and variant, with the numbers aligned in each column."""
        sign = "≤ " if "most" in self.bound else ""
        wide = [max(map(len, column)) for column in zip(*self.bounds, strict=True)]
        return [
            [
                f"{value}{'  ' + (sign if bound else ' ' * len(sign)) + bound.rjust(size) if size else ''}"
                for value, bound, size in zip(values, bounds, wide, strict=True)
            ]
            for values, bounds in zip(self.values, self.bounds, strict=True)
        ]

    def about(self) -> str:
        """Return the number of calls in a sentence."""
        if len(set(self.counts)) == 1:
            return f"{self.counts[0]} {self.what}{' each' if len(self.counts) > 1 else ''}."
        told = [f"{name} {number}" for name, number in zip(self.variants, self.counts, strict=True) if number]
        return f"Calls: {', '.join(told)}." if told else ""


def percentiles(report: Report) -> Percentiles | None:
    """Return the table, or None when the report has too few percentiles for one."""
    shown = percentile_names(report)
    rows = [row for row in report.rows if any(row.get(name) for name in shown)]
    if not shown or not rows:
        return None
    items = [[row.get(name) for row in rows] for name in shown]
    decimals = [_decimals([line[place] for line in items]) for place in range(len(rows))]
    flat = [item for line in items for item in line if item is not None and item.known]
    return Percentiles(
        [name.removeprefix("latency_") for name in shown],
        [plain(row.name) for row in rows],
        [[_value(item, digits) for item, digits in zip(line, decimals, strict=True)] for line in items],
        [[_bound(item, digits) for item, digits in zip(line, decimals, strict=True)] for line in items],
        [[plain(item.note) if item is not None and not item.known else "" for item in line] for line in items],
        _title(flat),
        [_count([line[place] for line in items]) for place in range(len(rows))],
        "ticks" if report.kind == "benchmark" and "hz" in report.limits else "calls",
    )


def _decimals(items: Sequence[Measurement | None]) -> int:
    """Return the decimals of a variant's column: three digits of its smallest number."""
    found = [item.value for item in items if item is not None and math.isfinite(item.value) and item.value > 0]
    return min(6, decimals_of(min(found))) if found else 0


def _value(item: Measurement | None, decimals: int) -> str:
    return fixed(item.value, decimals) if item is not None and item.known else NOTHING


def _bound(item: Measurement | None, decimals: int) -> str:
    if item is None or not item.known:
        return ""
    if item.low is None and item.high is not None:
        return fixed(item.high, decimals)
    return interval(item)


def _title(items: Sequence[Measurement]) -> str:
    bounded = [item for item in items if item.low is not None or item.high is not None]
    covers = {item.confidence for item in bounded}
    cover = f" ({number(covers.pop() * 100)} %)" if len(covers) == 1 else ""
    return ("at most" if all(item.low is None for item in bounded) else "interval") + cover


def _count(items: Sequence[Measurement | None]) -> str:
    most = max((item.samples for item in items if item is not None), default=0)
    return count(most).removeprefix("n = ")
