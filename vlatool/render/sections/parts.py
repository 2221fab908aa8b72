"""Memory by part, time by phase, cold start by part, latency by the way of calling: numbers with a bar beside each."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.measures import tables
from vlatool.render.cells import records_table
from vlatool.render.document import Section
from vlatool.report import Report

PARTS = {
    tables.MEMORY_PARTS: "MB", tables.PHASES: "share %", tables.START_PARTS: "ms", tables.DUTY_CYCLE: "p50 ms",
}  # fmt: skip
"""Title of a details table -> the column of which bars are drawn."""


class Parts:
    """Tables of what a benchmark takes apart."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the tables that there are."""
        if found := tuple(table for title, key in PARTS.items() if (table := records_table(report, title, key))):
            yield Section("Where memory and time go", found, 70, "measured", brief=False, folded=True)
