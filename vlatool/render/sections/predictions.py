"""What is predicted for a board: a section for each, before what was measured here when the variants are for it."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.render._columns import board
from vlatool.render._format import plain
from vlatool.render._view import brackets, places, quantities, ranks_boards
from vlatool.render.cells import matrix, remarks
from vlatool.render.document import Section
from vlatool.report import Report


class Predicted:
    """The numbers that a model computed for a profile."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return a section for each profile."""
        for where in () if ranks_boards(report) else places(report, "predicted"):
            table = matrix(report, quantities(report, "predicted", where), "predicted", where)
            yield Section(
                f"Predicted for {plain(where)}",
                (table, *remarks(report, "predicted", where=where)),
                10 if board(report) else 110,
                "predicted",
                "Computed by a model, not measured",
                brackets(report, "predicted", where),
            )
