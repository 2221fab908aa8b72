"""The percentiles of the latency: a percentile a line, a value and its bound for each variant."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from vlatool.measures import Quantity
from vlatool.measures.latency import LATENCY
from vlatool.render._format import count, decimals_of, fixed_decimals, interval, number, plain
from vlatool.render._view import missing_reasons, percentiles
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import ABSENT, Cell, Column, Line, Notes, Section, Table
from vlatool.report import Measurement, Report, Row


class Percentiles:
    """A table, when there are percentiles enough for one."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the table, and below it why a percentile could not be had."""
        shown = percentiles(report)
        rows = [(row, css) for row, css in with_colours(report.rows) if any(row.get(each) for each in shown)]
        if not rows:
            return
        items = {each: [row.get(each) for row, _ in rows] for each in shown}
        digits = [_decimals(column) for column in zip(*items.values(), strict=True)]
        lines = tuple(
            Line((Cell(LATENCY.pattern.part(each.name) or each.words), *map(_cell, items[each], digits)))
            for each in shown
        )
        bounded = any(cell.interval for line in lines for cell in line.cells)
        known = [item for line in items.values() for item in line if item is not None and item.known]
        heads = (Column("latency, ms", False), *(Column(plain(row.name), css=css) for row, css in rows))
        table = Table(heads, lines, beside=_title(known) if bounded else "", style="percentiles")
        variants = [row for row, _ in rows]
        reasons = tuple(missing_reasons(report, {each.name for each in shown}.__contains__))
        about = _calls(report, variants, shown)
        blocks = (table, Notes(reasons)) if reasons else (table,)
        yield Section("Latency percentiles", blocks, 30, "measured", about=about, brief=len(rows) == 1)


def _decimals(items: Sequence[Measurement | None]) -> int:
    """Return the decimals of a variant's column: three digits of its smallest number."""
    values = [item.value for item in items if item is not None and math.isfinite(item.value) and item.value > 0]
    return min(6, decimals_of(min(values))) if values else 0


def _cell(item: Measurement | None, decimals: int) -> Cell:
    if item is None or not item.known:
        return Cell(ABSENT, known=False)
    bound = f"≤ {fixed_decimals(item.high, decimals)}" if item.low is None and item.high is not None else interval(item)
    return Cell(fixed_decimals(item.value, decimals), bound)


def _title(items: Sequence[Measurement]) -> str:
    bounded = [item for item in items if item.low is not None or item.high is not None]
    covers = {item.confidence for item in bounded}
    cover = f" ({number(covers.pop() * 100)} %)" if len(covers) == 1 else ""
    return ("at most" if all(item.low is None for item in bounded) else "interval") + cover


def _calls(report: Report, rows: Sequence[Row], shown: Sequence[Quantity]) -> str:
    """Return the number of calls, or of ticks of a control loop, in a sentence."""
    what = "ticks" if report.kind == "benchmark" and "hz" in report.limits else "calls"
    counts = {
        plain(row.name): count(max(item.samples for each in shown if (item := row.get(each)))).removeprefix("n = ")
        for row in rows
    }
    if len(set(counts.values())) == 1:
        return f"{next(iter(counts.values()))} {what}{' each' if len(rows) > 1 else ''}."
    known = [f"{name} {number}" for name, number in counts.items() if number]
    return f"{what.capitalize()}: {', '.join(known)}." if known else ""
