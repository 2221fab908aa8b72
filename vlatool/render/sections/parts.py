"""Memory by part, time by phase and cold start by part: every number, and a bar beside it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from vlatool.render._cells import column_texts, texts
from vlatool.render._format import plain
from vlatool.render._view import measured_where
from vlatool.render.charts.svg import series
from vlatool.render.document import Bar, Cell, Column, Line, Section, Table
from vlatool.report import Report

PARTS = {"memory by part": "MB", "time by phase": "share %", "cold start by part": "ms"}
"""Title of a details table -> the column of which bars are drawn."""


class Parts:
    """Tables of what a benchmark takes apart."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the tables that there are."""
        tables = tuple(table for title, key in PARTS.items() if (table := _table(report, title, key)))
        if tables:
            where = measured_where(report)
            yield Section("Where memory and time go", tables, 70, "measured", where, brief=False, folded=True)


def _table(report: Report, title: str, key: str) -> Table | None:
    records = [
        (plain(row.name), css, dict(record))
        for row, css in zip(report.rows, series(report.rows), strict=True)
        for record in row.details.get(title, ())
        if record
    ]
    if not records:
        return None
    first = next(iter(records[0][2]))
    parts = [str(record.get(first)) for _, _, record in records]
    order = list(dict.fromkeys(parts))
    records.sort(key=lambda record: order.index(str(record[2].get(first))))
    names = list(dict.fromkeys(name for _, _, record in records for name in record if name != first))
    contents = [column_texts([record.get(name) for _, _, record in records]) for name in names]
    several = len({name for name, _, _ in records}) > 1
    top = max(_size(record.get(key)) for _, _, record in records)
    shown = [plain(record.get(first)) for _, _, record in records]
    heading = [shown[0], *(part if part != before else "" for before, part in pairwise(shown))]
    lines = tuple(
        Line(
            (
                Cell(part),
                *((Cell(name, css=css),) if several else ()),
                *texts(numbers),
                Cell(bar=Bar(_size(record.get(key)) / top if top else 0.0, css)),
            )
        )
        for part, (name, css, record), numbers in zip(heading, records, zip(*contents, strict=True), strict=True)
    )
    heads = [Column(first, False), *([Column("variant", False)] if several else [])]
    heads += [Column(plain(name), minor=name == "calls") for name in names]
    return Table((*heads, Column("", False)), lines, title, style="parts")


def _size(content: Any) -> float:
    number = isinstance(content, int | float) and not isinstance(content, bool)
    return float(content) if number and math.isfinite(content) and content > 0 else 0.0
