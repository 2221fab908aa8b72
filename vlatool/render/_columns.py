"""What a report for a board says of it: what is predicted beside what was measured here, and whose milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.render._format import full, label
from vlatool.render._view import headline, names, short
from vlatool.report import ON_BOARD, Measurement, Report, Row

FORETELLING = ("optimize", "benchmark", "evaluate")
"""Kinds of reports that tell of one variant what is predicted for a board."""
OF_THIS_HOST = {
    "latency_p50": "p50, this host",
    "peak_rss": "memory, this host",
    "deadline_misses": "deadline misses, this host",
}
"""Measured on this host, and not what the board would show; the other numbers hold anywhere, or are ratios."""


@dataclass(frozen=True)
class Column:
    """One number of every variant.

    Args:
        name: Of the measurement.
        origin: Measured or predicted.
        title: In words.
    """

    name: str
    origin: str
    title: str

    def of(self, row: Row) -> Measurement | None:
        """Return the number of a variant."""
        return row.get(self.name, self.origin)


@dataclass(frozen=True)
class Sides:
    """What is known of the variant that a report is about: measured here, and predicted for the board.

    Args:
        board: The profile.
        name: The variant.
        measured, predicted: (what, number with interval and count).
    """

    board: str
    name: str
    measured: tuple[tuple[str, str], ...]
    predicted: tuple[tuple[str, str], ...]


def board(report: Report) -> str:
    """Return the board that the variants are for; empty when there is none, or the machine is that board."""
    return foretold_for(report) if report.kind == "optimize" else ""


def foretold_for(report: Report) -> str:
    """Return the one board that latencies are predicted for, when the machine is not that board."""
    if report.kind not in FORETELLING:
        return ""
    found = {item.where for row in report.rows if (item := row.get("latency_p50", "predicted")) is not None}
    return found.pop() if len(found) == 1 and report.environment.get(ON_BOARD) not in found else ""


def columns(report: Report) -> list[Column]:
    """Return the columns of the table of variants; for a board, milliseconds of this host come last and say so."""
    shown = headline(report)
    if not board(report):
        return [Column(name, "measured", short(name)) for name in shown]
    here = [name for name in shown if name in OF_THIS_HOST]
    anywhere = [Column(name, "measured", short(name)) for name in shown if name not in here]
    return anywhere + [Column(name, "measured", OF_THIS_HOST[name]) for name in here]


def about(report: Report) -> str:
    """Return a sentence on what the columns are; empty without a board."""
    where = board(report)
    return f"Not measured on {where}: its latency, memory and energy are predicted above." if where else ""


def sides(report: Report) -> Sides | None:
    """Return both sides of the variant that was chosen, or of the one that was predicted for; None without a board."""
    where = foretold_for(report)
    foretold = [row for row in report.rows if row.get("latency_p50", "predicted")]
    if not where or not foretold:
        return None
    row = next((each for each in report.rows if each.role == "chosen"), foretold[0])
    shown = [column for column in columns(report) if column.origin == "measured"]
    if board(report):
        shown = [column for column in shown if column.name not in OF_THIS_HOST]
    foretell = [Column(name, "predicted", label(name)) for name in names(report, "predicted", where)]
    return Sides(where, row.name, _told(row, shown), _told(row, foretell))


def _told(row: Row, shown: list[Column]) -> tuple[tuple[str, str], ...]:
    found = ((column.title, column.of(row)) for column in shown)
    return tuple((title, full(item)) for title, item in found if item is not None)
