"""Tables of plain text that never exceed a width: columns that do not fit go below, under the same first column."""

from __future__ import annotations

from collections.abc import Sequence

from rich.cells import cell_len, set_cell_size

from vlatool.render.document import Line, Table


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
