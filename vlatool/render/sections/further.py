"""The measured numbers that stand nowhere else, how they were had, and what could not be had."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.render._view import further, missing_reasons, percentiles, ranks_boards
from vlatool.render.cells import matrix, remarks
from vlatool.render.document import Block, Notes, Section
from vlatool.report import Report


class Further:
    """Everything else that was measured."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the table, the methods, and the reasons for what is missing."""
        if ranks_boards(report):
            return
        shown, elsewhere = further(report), {each.name for each in percentiles(report)}
        blocks: list[Block] = [matrix(report, shown, "measured")] if shown else []
        blocks += remarks(report, "measured", "Methods")
        if missing := missing_reasons(report, lambda name: name not in elsewhere, further=True):
            blocks.append(Notes(tuple(missing), "Unmeasured"))
        if blocks:
            title = "Further measurements and methods"
            yield Section(title, tuple(blocks), 90, "measured", brief=False, folded=True)
