"""Cells and tables of measurements, for the sections."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from vlatool.render._format import cell, count, fixed, label, plain, quantity, span
from vlatool.render._view import notes
from vlatool.render.charts.svg import series
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


def matrix(report: Report, shown: Sequence[str], origin: str, where: str | None = None) -> Table:
    """Return a table of one kind of numbers from one place: a number a line, a variant a column.

    Args:
        report: The report.
        shown: Names of measurements.
        origin: Measured or predicted.
        where: Only the numbers from there.
    """
    numbers = [
        {item.name: item for item in row.measurements if item.origin == origin and where in (None, item.where)}
        for row in report.rows
    ]
    kept = [index for index, items in enumerate(numbers) if any(name in items for name in shown)]
    tints = series(report.rows)
    columns = [Column("measurement", False), *(Column(report.rows[index].name, css=tints[index]) for index in kept)]
    lines = [Line((Cell(label(name)), *(number(numbers[index].get(name)) for index in kept))) for name in shown]
    return Table(tuple(columns), tuple(lines))


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


def column_texts(contents: Sequence[Any]) -> list[str]:
    """Return the texts of one column of a details table; its floats get the same decimals."""
    floats = [item for item in contents if isinstance(item, float) and math.isfinite(item)]
    shown = [f"{item:.4g}" for item in floats]
    if any("e" in text for text in shown):
        return [cell(item) for item in contents]
    decimals = max((len(text.partition(".")[2]) for text in shown), default=0)
    return [
        fixed(item, decimals) if isinstance(item, float) and math.isfinite(item) else cell(item) for item in contents
    ]
