"""A table as plain text: what qualifies a number stands below it, or beside it where there is room for a column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich.cells import cell_len, set_cell_size

from vlatool.render._format import plain
from vlatool.render.cells import texts
from vlatool.render.document import Cell, Column, Line, Table

SHARED_ROLE = "shared"
"""The role of a line that holds the counts which all numbers of a column share."""


def layout(table: Table, most: int) -> Table:
    """Return the first ``most`` lines of a table as one whose cells are text alone."""
    kept = table.filled_columns()
    columns = tuple(replace(table.columns[index], title=plain(table.columns[index].title)) for index in kept)
    lines = [replace(line, cells=tuple(line.cells[index] for index in kept)) for line in table.lines[:most]]
    if any(cell.brackets for line in lines for cell in line.cells[1:]):
        if len(lines) == 1 and len(columns) > 2:
            columns, lines = _turned(columns, lines[0].cells)
        if len(columns) == 2:
            return _list(columns, lines, table.beside or "interval")
    return Table(columns, tuple(_joined(lines) if table.beside else _stacked(lines)))


def _turned(columns: Sequence[Column], cells: Sequence[Cell]) -> tuple[tuple[Column, ...], list[Line]]:
    """Return a table of one line as a list: a number a line."""
    title = ", ".join(part for part in (cells[0].text, cells[0].note) if part)
    numbers = zip(columns[1:], cells[1:], strict=True)
    return (Column(title, False), Column("value")), [Line((Cell(column.title), cell)) for column, cell in numbers]


def _list(columns: Sequence[Column], lines: Sequence[Line], beside: str) -> Table:
    """Return one number a line, with its interval and its count beside it."""
    body = []
    for name, cell in (line.cells for line in lines):
        last = ", ".join(part for part in (cell.count, cell.note if cell.known else "") if part)
        body.append((name.text, cell.text, cell.interval, last))
    kept = [index for index in range(4) if index < 2 or any(line[index] for line in body)]
    heads = (*columns, Column(beside), Column(""))
    shown = (Line(texts(line[index] for index in kept)) for line in body)
    return Table(tuple(heads[index] for index in kept), tuple(shown))


def _joined(lines: Sequence[Line]) -> list[Line]:
    """Return number and interval in one cell, aligned within a column."""
    shown = []
    for cells in zip(*(line.cells for line in lines), strict=True):
        wide = max(len(cell.interval) for cell in cells)
        shown.append([f"{cell.text}  {cell.interval.rjust(wide)}" if wide else cell.text for cell in cells])
    return [Line(texts(line)) for line in zip(*shown, strict=True)]


def _stacked(lines: Sequence[Line]) -> list[Line]:
    """Return number, interval and count below each other; a count that a column or a line shares stands once."""
    shared = [_shared(cells) if len(lines) > 1 else "" for cells in zip(*(line.cells for line in lines), strict=True)]
    body = [Line(texts(shared), SHARED_ROLE)] if any(shared) else []
    return body + [Line(texts(part), best=line.best) for line in lines for part in _parts(line.cells, shared)]


def _shared(cells: Sequence[Cell]) -> str:
    counts = {cell.count for cell in cells if cell.known}
    return counts.pop() if len(counts) == 1 else ""


def _parts(cells: Sequence[Cell], shared: Sequence[str]) -> list[list[str]]:
    counts = ["" if once else cell.count for cell, once in zip(cells, shared, strict=True)]
    intervals, notes = [cell.interval for cell in cells], [cell.note if cell.known else "" for cell in cells]
    same = {count for count in counts if count}
    if cells[0].note:
        intervals[0], notes[0] = f"  {cells[0].note}", ""
    elif len(same) == 1 and not any(shared):
        intervals[0], counts = f"  {same.pop()}", [""] * len(cells)
    return [[cell.text for cell in cells], intervals, counts, notes]


def grid(table: Table, width: int) -> list[tuple[Line | None, str]]:
    """Return (the line of the table that is shown, or None; its text) for each line of text.

    Args:
        table: Its first column names the lines and is repeated when the table is split; a line of which nothing but
            blanks would be shown is left out.
        width: Columns that no line exceeds.
    """
    heads = [column.title for column in table.columns]
    body = [[cell.text for cell in line.cells] for line in table.lines]
    wide = [max(map(cell_len, column)) for column in zip(heads, *body, strict=True)]
    wide[0] = min(wide[0], max(12, int(width * 0.4)))
    gap = 2 if sum(wide) + 2 * len(wide) - 2 <= width else 1
    wide = [wide[0], *(min(size, width - gap - wide[0]) for size in wide[1:])]
    lines: list[tuple[Line | None, str]] = []
    for columns in _chunks(wide, width, gap):
        shown = [0, *columns]

        def text(row: Sequence[str], shown: Sequence[int] = shown) -> str:
            cells = (_fit(row[index], wide[index], table.columns[index].numeric) for index in shown)
            return (" " * gap).join(cells).rstrip()

        rule = "─" * (sum(wide[index] for index in shown) + gap * len(columns))
        lines += [*([(None, "")] if lines else []), (None, text(heads)), (None, rule)]
        rows = zip(table.lines, body, strict=True)
        lines += [(line, text(row)) for line, row in rows if any(row[index].strip() for index in shown)]
    return lines


def _chunks(wide: Sequence[int], width: int, gap: int) -> list[list[int]]:
    chunks: list[list[int]] = [[]]
    used = wide[0]
    for index in range(1, len(wide)):
        if used + gap + wide[index] > width:
            chunks.append([])
            used = wide[0]
        chunks[-1].append(index)
        used += gap + wide[index]
    return [chunk for chunk in chunks if chunk] or [[]]


def _fit(text: str, width: int, right: bool) -> str:
    if cell_len(text) > width:
        return set_cell_size(text, width - 1) + "…"
    blank = " " * (width - cell_len(text))
    return blank + text if right else text + blank
