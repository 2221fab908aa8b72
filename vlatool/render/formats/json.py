"""The report as JSON: every number unrounded and every raw sample."""

from __future__ import annotations

from vlatool.report import Report


class JsonRenderer:
    """Writes the report in its own schema, which ``Report.from_json`` reads."""

    def render(self, report: Report) -> str:
        """Return the JSON text."""
        return report.to_json()
