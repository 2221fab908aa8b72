"""The details of the rows as tables of texts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vlatool.render._format import cell, fixed, plain
from vlatool.render._view import ABSENT
from vlatool.report import Report

TABLES = ("memory by part", "time by phase", "cold start by part", "telemetry")
"""The details that come first, in this order."""


@dataclass(frozen=True)
class Table:
    """A table of texts; ``numeric`` tells which columns to align right."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]


def details(report: Report, passed_over: Sequence[str] = ()) -> list[Table]:
    """Return the details of all rows; the same table of several variants becomes one, with a column for the variant.

    Args:
        report: The report.
        passed_over: Titles of tables that are shown elsewhere.
    """
    by_title: dict[str, list[tuple[str, dict[str, Any]]]] = {title: [] for title in TABLES}
    for row in report.rows:
        for title, records in row.details.items():
            if title in (ABSENT, *passed_over):
                continue
            records = [record for record in records if record]
            by_title.setdefault(title, []).extend((row.name, dict(record)) for record in records)
    return [_details_table(plain(title), records) for title, records in by_title.items() if records]


def _details_table(title: str, records: list[tuple[str, dict[str, Any]]]) -> Table:
    columns = list(dict.fromkeys(key for _, record in records for key in record))
    several = len({name for name, _ in records}) > 1
    if several:
        order = list(dict.fromkeys(cell(record.get(columns[0])) for _, record in records))
        records = sorted(records, key=lambda item: order.index(cell(item[1].get(columns[0]))))
    numeric = [
        all(
            isinstance(record.get(key), int | float | None) and not isinstance(record.get(key), bool)
            for _, record in records
        )
        for key in columns
    ]
    by_column = [column_texts([record.get(key) for _, record in records]) for key in columns]
    rows = list(zip(*by_column, strict=True))
    heads = tuple(plain(key) for key in columns)
    if not several:
        only = plain(records[0][0])
        return Table(f"{title}: {only}", heads, tuple(rows), tuple(numeric))
    lead: list[tuple[str, ...]] = []
    group = ""
    for (name, _), row in zip(records, rows, strict=True):
        again = bool(lead) and row[0] == group
        group = row[0]
        lead.append(("" if again and not numeric[0] else row[0], plain(name), *row[1:]))
    return Table(title, (heads[0], "variant", *heads[1:]), tuple(lead), (numeric[0], False, *numeric[1:]))


def column_texts(contents: Sequence[Any]) -> list[str]:
    """Return the texts of one column; its floats get the same decimals."""
    floats = [item for item in contents if isinstance(item, float) and math.isfinite(item)]
    texts = [f"{item:.4g}" for item in floats]
    if any("e" in text for text in texts):
        return [cell(item) for item in contents]
    decimals = max((len(text.partition(".")[2]) for text in texts), default=0)
    return [
        fixed(item, decimals) if isinstance(item, float) and math.isfinite(item) else cell(item) for item in contents
    ]
