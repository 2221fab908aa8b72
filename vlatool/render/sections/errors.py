"""How far the actions are off, by dimension."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.render._format import label, plain
from vlatool.render._view import error_groups
from vlatool.render.cells import bars, number
from vlatool.render.charts.svg import tinted
from vlatool.render.document import Cell, Column, Line, Section, Table
from vlatool.report import Report


class Errors:
    """A table for each thing that the actions were compared with."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return a dimension a line, a variant a column, and bars that compare the variants."""
        for group, members in error_groups(report).items():
            rows = [(row, css) for row, css in tinted(report.rows) if any(row.get(name) for name in members)]
            lines = []
            for name in members:
                items = [row.get(name) for row, _ in rows]
                drawn = map(number, items, bars(items, [css for _, css in rows]))
                lines.append(Line((Cell(plain(name.partition(".")[2])), *drawn)))
            heads = (Column("dimension", False), *(Column(plain(row.name), css=css) for row, css in rows))
            table = Table(heads, tuple(lines), style="small")
            note = plain(next(item.note for row, _ in rows for name in members if (item := row.get(name))))
            about = f"{note[:1].upper()}{note[1:]}." if note else ""
            title = f"Action {label(group)} by dimension"
            yield Section(title, (table,), 80, "measured", about=about, brief=False, folded=True)
