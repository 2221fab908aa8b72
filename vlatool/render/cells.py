"""Cells and tables of measurements, for the sections."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from vlatool.measures import Quantity
from vlatool.render._format import cell, count, fixed_decimals, plain, quantity, span
from vlatool.render._view import is_number, notes
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import MISSING, Bar, Cell, Column, Line, Notes, Table
from vlatool.report import Measurement, Report


def number(item: Measurement | None, bar: Bar | None = None, tail: str = "", note: str = "") -> Cell:
    """Return the cell of a number: its interval and its count; the reason where it could not be had."""
    if item is None:
        return MISSING
    if not item.known:
        return Cell(quantity(item), note=plain(item.note), known=False)
    return Cell(quantity(item), span(item), count(item.samples), note, bar=bar, tail=tail)


def texts(contents: Iterable[str]) -> tuple[Cell, ...]:
    """Return cells that hold text alone."""
    return tuple(Cell(text) for text in contents)


def matrix(report: Report, shown: Sequence[Quantity], origin: str, where: str | None = None) -> Table:
    """Return a table of one kind of numbers from one place: a number a line, a variant a column.

    Args:
        origin: Measured or predicted.
        where: Only the numbers from there.
    """
    variants = []
    for row, css in with_colours(report.rows):
        items = {item.name: item for item in row.measurements if item.origin == origin and where in (None, item.where)}
        if any(each.name in items for each in shown):
            variants.append((Column(plain(row.name), css=css), items))
    columns = (Column("measurement", False), *(column for column, _ in variants))
    lines = (
        Line((Cell(plain(each.words)), *(number(items.get(each.name)) for _, items in variants))) for each in shown
    )
    return Table(columns, tuple(lines))


def remarks(report: Report, origin: str, title: str = "", where: str | None = None) -> list[Notes]:
    """Return the notes of the numbers of an origin as a list; nothing when there are none."""
    lines = tuple(notes(report, origin, where))
    return [Notes(lines, title)] if lines else []


def bars(items: Sequence[Measurement | None], tints: Sequence[str], limit: float | None = None) -> list[Bar | None]:
    """Return a bar for each number, from zero and on one scale, which a limit extends."""
    top = max([limit or 0.0, *(reach(item) for item in items if item is not None)])
    return [_bar(item, top, css, limit) for item, css in zip(items, tints, strict=True)]


def reach(item: Measurement) -> float:
    """Return how far the bar of a number, or its interval, goes."""
    return max((value for value in (item.value, item.high or 0.0) if math.isfinite(value)), default=0.0)


def _bar(item: Measurement | None, top: float, css: str, limit: float | None) -> Bar | None:
    if item is None or not math.isfinite(item.value) or item.value < 0 or top <= 0:
        return None
    bounds = (item.low, item.high) if item.low is not None and item.high is not None else (None, None)
    low, high, mark = (None if bound is None else min(1.0, max(0.0, bound / top)) for bound in (*bounds, limit))
    return Bar(min(1.0, item.value / top), css, low, high, mark)


def records_table(report: Report, title: str, bars_of: str = "") -> Table | None:
    """Return the details of that title: a record a line, that of several variants under each other.

    Args:
        bars_of: Name of the number that gets a bar.
    """
    records = [
        (plain(row.name), css, one)
        for row, css in with_colours(report.rows)
        for one in row.details.get(title, ())
        if one
    ]
    if not records:
        return None
    keys = list(dict.fromkeys(key for _, _, record in records for key in record))
    several = len({name for name, _, _ in records}) > 1
    if several:
        order = list(dict.fromkeys(cell(record.get(keys[0])) for _, _, record in records))
        records.sort(key=lambda item: order.index(cell(item[2].get(keys[0]))))
    contents = [[record.get(key) for _, _, record in records] for key in keys]
    first, *others = [
        Column(
            plain(key), all(each is None or is_number(each) for each in content), minor=bool(bars_of) and key == "calls"
        )
        for key, content in zip(keys, contents, strict=True)
    ]
    lines, before = [], ""
    top = max([_length(record.get(bars_of)) for _, _, record in records])
    for (name, css, record), (group, *rest) in zip(records, zip(*map(_texts, contents), strict=True), strict=True):
        begins = Cell(group if group != before or first.numeric or not several else "")
        whose = [Cell(name, css=css)] if several else []
        bar = [Cell(bar=Bar(_length(record.get(bars_of)) / (top or 1.0), css))] if bars_of else []
        lines.append(Line((begins, *whose, *texts(rest), *bar)))
        before = group
    columns = (
        first,
        *([Column("variant", False)] if several else []),
        *others,
        *([Column("", False)] if bars_of else []),
    )
    heading = plain(title) if several else f"{plain(title)}: {records[0][0]}"
    return Table(columns, tuple(lines), heading, style="parts" if bars_of else "groups")


def _length(content: Any) -> float:
    return float(content) if is_number(content) and math.isfinite(content) and content > 0 else 0.0


def _texts(contents: Sequence[Any]) -> list[str]:
    """Return the texts of one column; its floats get the same decimals."""
    floats = [item for item in contents if isinstance(item, float) and math.isfinite(item)]
    shown = [f"{item:.4g}" for item in floats]
    if any("e" in text for text in shown):
        return [cell(item) for item in contents]
    decimals = max((len(text.partition(".")[2]) for text in shown), default=0)
    return [
        fixed_decimals(item, decimals) if isinstance(item, float) and math.isfinite(item) else cell(item)
        for item in contents
    ]
