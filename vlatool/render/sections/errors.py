"""How far the actions are off, by dimension."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.render._format import label, plain
from vlatool.render._view import error_groups, measured_where
from vlatool.render.cells import bars, number
from vlatool.render.charts.svg import series
from vlatool.render.document import Cell, Column, Line, Section, Table
from vlatool.report import Report


class Errors:
    """A table for each thing that the actions were compared with."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return a dimension a line, a variant a column, and bars that compare the variants."""
        for group, members in error_groups(report).items():
            rows = [
                (row, css)
                for row, css in zip(report.rows, series(report.rows), strict=True)
                if any(row.get(name) for name in members)
            ]
            tints = [css for _, css in rows]
            lines = []
            for name in members:
                items = [row.get(name) for row, _ in rows]
                lines.append(Line((Cell(plain(name.partition(".")[2])), *map(number, items, bars(items, tints)))))
            heads = (Column("dimension", False), *(Column(plain(row.name), css=css) for row, css in rows))
            note = next(item.note for row, _ in rows for name in members if (item := row.get(name)))
            yield Section(
                f"Action {label(group)} by dimension",
                (Table(heads, tuple(lines), style="small"),),
                80,
                "measured",
                measured_where(report),
                f"{plain(note)[:1].upper()}{plain(note)[1:]}." if note else "",
                brief=False,
                folded=True,
            )
