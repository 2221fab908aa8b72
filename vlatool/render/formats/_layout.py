"""A table as plain text: what qualifies a number stands below it, or beside it where there is room for a column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from vlatool.render._format import plain
from vlatool.render.document import Cell, Column, Line, Table


@dataclass
class Layout:
    """What ``grid`` draws.

    Args:
        heads: Titles of the columns.
        numeric: Which of them to align right.
        body: Texts, line by line.
        styles: Index of a line in ``body`` -> its style.
        legend: What a sign before the numbers means.
    """

    heads: list[str]
    numeric: list[bool]
    body: list[list[str]] = field(default_factory=list)
    styles: dict[int, str] = field(default_factory=dict)
    legend: str = ""


def layout(table: Table, most: int) -> Layout:
    """Return the texts of a table, of the first ``most`` lines."""
    kept = table.worded()
    table = replace(
        table,
        columns=tuple(replace(table.columns[place], title=plain(table.columns[place].title)) for place in kept),
        lines=tuple(replace(line, cells=tuple(line.cells[place] for place in kept)) for line in table.lines[:most]),
    )
    qualified = any(cell.aside for line in table.lines for cell in line.cells[1:])
    if qualified and len(table.lines) == 1 and len(table.columns) > 2:
        table = _turned(table)
    if qualified and len(table.columns) == 2:
        return _list(table)
    return _joined(table) if table.beside else _stacked(table)


def _turned(table: Table) -> Table:
    """Return a table of one line as a list: a number a line."""
    (line,) = table.lines
    name, *cells = line.cells
    title = ", ".join(part for part in (name.text, name.note) if part)
    lines = (Line((Cell(column.title), cell)) for column, cell in zip(table.columns[1:], cells, strict=True))
    return Table((Column(title, False), Column("value")), tuple(lines), beside=table.beside)


def _list(table: Table) -> Layout:
    """Return one number a line, with its interval and its count beside it."""
    first, second = table.columns
    body = []
    for line in table.lines:
        name, cell = line.cells
        last = ", ".join(part for part in (cell.count, cell.note if cell.known else "") if part)
        body.append([name.text, cell.text, cell.interval, last])
    heads = [first.title, second.title, table.beside or "interval", ""]
    kept = [place for place in range(4) if place < 2 or any(line[place] for line in body)]
    numeric = [False, True, True, True]
    return Layout(
        [heads[place] for place in kept],
        [numeric[place] for place in kept],
        [[line[place] for place in kept] for line in body],
    )


def _joined(table: Table) -> Layout:
    """Return number and interval in one cell, aligned within a column."""
    columns = list(zip(*(line.cells for line in table.lines), strict=True))
    texts = [[cell.text for cell in columns[0]]]
    for cells in columns[1:]:
        wide = max(len(cell.interval) for cell in cells)
        texts.append([f"{cell.text}  {cell.interval.rjust(wide)}" if wide else cell.text for cell in cells])
    signed = any(cell.interval.startswith("≤") for line in table.lines for cell in line.cells)
    drawn = _plain(table)
    drawn.body = [list(line) for line in zip(*texts, strict=True)]
    drawn.legend = f"≤: {table.beside}." if signed else ""
    return drawn


def _plain(table: Table) -> Layout:
    return Layout([column.title for column in table.columns], [column.numeric for column in table.columns])


def _stacked(table: Table) -> Layout:
    """Return number, interval and count below each other; a count that a column or a line shares stands once."""
    drawn = _plain(table)
    shared = [_shared(cells) for cells in zip(*(line.cells for line in table.lines), strict=True)]
    if len(table.lines) > 1 and any(shared):
        drawn.styles[0] = "dim"
        drawn.body.append(shared)
    else:
        shared = [""] * len(table.columns)
    for line in table.lines:
        if line.best:
            drawn.styles[len(drawn.body)] = "bold green"
        drawn.body += _lines(line.cells, shared)
    return drawn


def _shared(cells: Sequence[Cell]) -> str:
    counts = {cell.count for cell in cells if cell.known}
    return counts.pop() if len(counts) == 1 else ""


def _lines(cells: Sequence[Cell], shared: Sequence[str]) -> list[list[str]]:
    counts = ["" if once else cell.count for cell, once in zip(cells, shared, strict=True)]
    intervals, notes = [cell.interval for cell in cells], [cell.note if cell.known else "" for cell in cells]
    same = {count for count in counts if count}
    if cells[0].note:
        intervals[0], notes[0] = f"  {cells[0].note}", ""
    elif len(same) == 1 and not any(shared):
        intervals[0], counts = f"  {same.pop()}", [""] * len(cells)
    return [[cell.text for cell in cells], intervals, counts, notes]
