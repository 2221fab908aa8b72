"""How far the actions are off, by dimension."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.render._format import plain
from vlatool.render._view import elements
from vlatool.render.cells import bars, number
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import Cell, Column, Line, Section, Table
from vlatool.report import Report


class Errors:
    """A table for each thing that the actions were compared with."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return a dimension a line, a variant a column, and bars that compare the variants."""
        for group, members in elements(report).items():
            rows = [(row, css) for row, css in with_colours(report.rows) if any(row.get(each) for each in members)]
            lines = []
            for each in members:
                items = [row.get(each) for row, _ in rows]
                drawn = map(number, items, bars(items, [css for _, css in rows]))
                lines.append(Line((Cell(plain(each.part)), *drawn)))
            heads = (Column("dimension", False), *(Column(plain(row.name), css=css) for row, css in rows))
            table = Table(heads, tuple(lines), style="small")
            note = plain(next(item.note for row, _ in rows for each in members if (item := row.get(each))))
            about = f"{note[:1].upper()}{note[1:]}." if note else ""
            title = f"Action {group} by dimension"
            yield Section(title, (table,), 80, "measured", about=about, brief=False, folded=True)
