"""Tables of plain text that never exceed a width: columns that do not fit go below, under the same first column."""

from __future__ import annotations

from collections.abc import Sequence

from rich.cells import cell_len, set_cell_size

HEAD = -1


def grid(
    heads: Sequence[str], body: Sequence[Sequence[str]], width: int, numeric: Sequence[bool] | None = None
) -> list[tuple[int, str]]:
    """Return (index of the row in ``body``, or ``HEAD``; the line) for each line of the table.

    Args:
        heads: Column titles; the first column names the rows and is repeated when the table is split.
        body: Cells by row; a row of which nothing but blanks would be shown is left out.
        width: Columns that no line exceeds.
        numeric: Which columns to align right; all but the first when None.
    """
    right = list(numeric) if numeric is not None else [False] + [True] * (len(heads) - 1)
    wide = [max(cell_len(row[index]) for row in (heads, *body)) for index in range(len(heads))]
    wide[0] = min(wide[0], max(12, int(width * 0.4)))
    gap = 2 if sum(wide) + 2 * len(wide) - 2 <= width else 1
    wide = [wide[0], *(min(size, width - gap - wide[0]) for size in wide[1:])]
    lines: list[tuple[int, str]] = []
    for columns in _chunks(wide, width, gap):
        if lines:
            lines.append((HEAD, ""))
        shown = [0, *columns]
        lines.append((HEAD, _line(heads, shown, wide, right, gap)))
        lines.append((HEAD, "─" * (sum(wide[index] for index in shown) + gap * len(columns))))
        for number, row in enumerate(body):
            if any(row[index].strip() for index in shown):
                lines.append((number, _line(row, shown, wide, right, gap)))
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


def _line(row: Sequence[str], shown: Sequence[int], wide: Sequence[int], right: Sequence[bool], gap: int) -> str:
    return (" " * gap).join(_fit(row[index], wide[index], right[index]) for index in shown).rstrip()


def _fit(text: str, width: int, right: bool) -> str:
    if cell_len(text) > width:
        return set_cell_size(text, width - 1) + "…"
    blank = " " * (width - cell_len(text))
    return blank + text if right else text + blank
