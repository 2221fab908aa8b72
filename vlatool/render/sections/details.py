"""The details of the rows as tables; the same table of several variants becomes one."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.measures import tables as names
from vlatool.render._view import ranks_boards
from vlatool.render.cells import records_table
from vlatool.render.document import Section, Table
from vlatool.render.sections.parts import PARTS
from vlatool.report import Report

OTHER_SECTIONS = {
    *PARTS, names.MISSING_VALUES, names.UNDER, names.EPISODE, names.AGAINST_BY_TASK, names.AGAINST_BY_INSTRUCTION,
}  # fmt: skip
"""What other sections draw."""


class Details:
    """What else the rows hold."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return every table of details that no other section draws."""
        if not ranks_boards(report) and (shown := tables(report)):
            yield Section("Details", tuple(shown), 100, brief=False, folded=True)


def tables(report: Report) -> list[Table]:
    """Return the tables, that of the telemetry first."""
    titles = dict.fromkeys((names.TELEMETRY, *(title for row in report.rows for title in row.details)))
    shown = (title for title in titles if title not in OTHER_SECTIONS and names.ROUNDS.part(title) is None)
    return [table for title in shown if (table := records_table(report, title))]
