"""The details of the rows as tables; the same table of several variants becomes one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from vlatool.render._cells import column_texts, texts
from vlatool.render._format import cell, plain
from vlatool.render._view import ABSENT, ranks_boards
from vlatool.render.document import Column, Line, Section, Table
from vlatool.render.sections.parts import PARTS
from vlatool.report import Report


class Details:
    """What else the rows hold."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return every table of details that no other section draws."""
        if not ranks_boards(report) and (found := tables(report)):
            yield Section("Details", tuple(found), 100, brief=False, folded=True)


def tables(report: Report) -> list[Table]:
    """Return the tables, that of the telemetry first."""
    by_title: dict[str, list[tuple[str, dict[str, Any]]]] = {"telemetry": []}
    for row in report.rows:
        for title, records in row.details.items():
            if title not in (ABSENT, *PARTS):
                kept = [(plain(row.name), dict(record)) for record in records if record]
                by_title.setdefault(title, []).extend(kept)
    return [_table(plain(title), records) for title, records in by_title.items() if records]


def _table(title: str, records: list[tuple[str, dict[str, Any]]]) -> Table:
    keys = list(dict.fromkeys(key for _, record in records for key in record))
    several = len({name for name, _ in records}) > 1
    if several:
        order = list(dict.fromkeys(cell(record.get(keys[0])) for _, record in records))
        records = sorted(records, key=lambda item: order.index(cell(item[1].get(keys[0]))))
    contents = [[record.get(key) for _, record in records] for key in keys]
    columns = [Column(plain(key), all(map(_is_number, column))) for key, column in zip(keys, contents, strict=True)]
    rows = list(zip(*map(column_texts, contents), strict=True))
    if not several:
        return _grouped(f"{title}: {records[0][0]}", columns, rows)
    named = [
        ("" if index and not columns[0].numeric and rows[index - 1][0] == row[0] else row[0], name, *row[1:])
        for index, (row, (name, _)) in enumerate(zip(rows, records, strict=True))
    ]
    return _grouped(title, [columns[0], Column("variant", False), *columns[1:]], named)


def _grouped(title: str, columns: list[Column], rows: list[tuple[str, ...]]) -> Table:
    return Table(tuple(columns), tuple(Line(texts(row)) for row in rows), title, style="groups")


def _is_number(content: Any) -> bool:
    return isinstance(content, int | float | None) and not isinstance(content, bool)
