"""What the numbers were had with: the machine, what to know before trusting them, and the command."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.render._format import plain
from vlatool.render._view import facts
from vlatool.render.document import Code, Notes, Pairs, Section
from vlatool.report import Report


class Circumstances:
    """Environment, warnings, and how to reproduce it."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the sections that the report has something for."""
        if pairs := facts(report.environment):
            yield Section("Environment", (Pairs(tuple(pairs)),), 130, brief=False, folded=True)
        if report.warnings:
            yield Section("Warnings", (Notes(report.warnings, warning=True),), 140, anchor="warnings")
        if report.command:
            yield Section("Reproduce", (Code(plain(report.command)),), 150, brief=False)
