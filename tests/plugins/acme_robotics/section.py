"""A section of every report: how many inferences an hour holds."""

from vlatool.render.document import Cell, Column, Line, Section, Table


class AnHour:
    """One number for each variant whose latency was measured."""

    def build(self, report):
        """Return the section, when there is something to show."""
        latencies = {row.name: row.value("latency_p50") for row in report.rows}
        lines = [Line((Cell(name), Cell(f"{3.6e6 / ms:,.0f}"))) for name, ms in latencies.items() if ms > 0]
        if lines:
            table = Table((Column("variant", numeric=False), Column("inferences")), tuple(lines))
            yield Section("Inferences in an hour", (table,), order=35, origin="measured", where="From the latency p50")
