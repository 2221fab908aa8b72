"""The variants: the few numbers that decide, and why each variant has its role."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from vlatool.measures.latency import LATENCY_P50, LATENCY_P99, SPEEDUP
from vlatool.render._columns import about, columns
from vlatool.render._format import plain, quantity, span
from vlatool.render._view import brackets, latency, place, places, ranks_boards, role
from vlatool.render.cells import bars, number, reach
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import Bar, Cell, Column, Line, Section, Table, Text
from vlatool.report import Measurement, Report, Row

FAR_RATIO = 2.5
"""A limit that is further away than this many times the longest bar is left out."""


class Variants:
    """One line for each variant."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the table; a sentence where there are no rows."""
        if ranks_boards(report):
            return
        if not report.rows:
            yield Section("Variants", (Text("The report has no rows."),), 20)
            return
        shown = columns(report)
        numbers = any(item.known for row in report.rows for item in row.measurements if item.origin == "measured")
        if not shown and numbers and not any(row.reason for row in report.rows):
            return  # what was measured stands in another section
        heads = (Column(title, bars=each == LATENCY_P50) for each, title in shown.items())
        lines = []
        for (row, css), bar in zip(with_colours(report.rows), _bars(report), strict=True):
            items = [row.get(each) for each in shown]
            where = next((item.where for item in items if item), "this host")
            note = f"on {place(report, where)}" if len(places(report, "measured")) > 1 else ""
            cells = (Cell(plain(row.name), note=note, css=css), *(_cell(row, item, bar, where) for item in items))
            words = "" if row.role in ("subject", row.name) else role(row)
            lines.append(Line(cells, words, plain(row.reason), row.role == "chosen"))
        table = Table((Column("variant", False), *heads), tuple(lines), style="cards")
        how = " ".join(part for part in (about(report), brackets(report, "measured")) if part)
        yield Section("Variants", (table,), 20, "measured", about=how)


def _cell(row: Row, item: Measurement | None, bar: Bar | None, where: str) -> Cell:
    """Return the cell of a number: latencies have a bar and their p99, what was measured elsewhere says so."""
    beside, tail = row.get(LATENCY_P50), row.get(LATENCY_P99)
    if item is None:
        return number(item)
    if item.name == SPEEDUP.name and beside is not None and item.samples == beside.samples:
        item = replace(item, samples=0)
    note = f"on {plain(item.where)}" if item.where != where else ""
    if item.name != LATENCY_P50.name:
        return number(item, note=note)
    known = tail is not None and tail.known
    spoken = f"p99 {quantity(tail)}{f' ({span(tail)})' if span(tail) else ''}" if known and tail is not None else ""
    return number(item, bar, spoken, note)


def _bars(report: Report) -> list[Bar | None]:
    aim, items = latency(report), [row.get(LATENCY_P50) for row in report.rows]
    longest = max((reach(item) for item in items if item is not None), default=0.0)
    near = aim.quantity == LATENCY_P50 and aim.limit is not None and aim.limit < FAR_RATIO * longest
    return bars(items, [css for _, css in with_colours(report.rows)], aim.limit if near else None)
