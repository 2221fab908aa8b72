"""What a report for a board says of it: what is predicted beside what was measured here, and whose milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.render._format import full, label
from vlatool.render._view import headline, names, short
from vlatool.report import ON_BOARD, Report, Row

PREDICTING = ("optimize", "benchmark", "evaluate")
"""Kinds of reports that have predictions for a board beside what was measured."""
OF_THIS_HOST = {
    "latency_p50": "p50, this host",
    "peak_rss": "memory, this host",
    "deadline_misses": "deadline misses, this host",
}
"""Measured on this host, and not what the board would show; the other numbers hold anywhere, or are ratios."""


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
    return predicted_for(report) if report.kind == "optimize" else ""


def predicted_for(report: Report) -> str:
    """Return the one board that latencies are predicted for, when the machine is not that board."""
    if report.kind not in PREDICTING:
        return ""
    boards = {item.where for row in report.rows if (item := row.get("latency_p50", "predicted")) is not None}
    return boards.pop() if len(boards) == 1 and report.environment.get(ON_BOARD) not in boards else ""


def columns(report: Report) -> dict[str, str]:
    """Return name -> title of the columns of the variants; for a board, milliseconds of this host come last, named."""
    shown = headline(report)
    if not board(report):
        return {name: short(name) for name in shown}
    anywhere = {name: short(name) for name in shown if name not in OF_THIS_HOST}
    return anywhere | {name: OF_THIS_HOST[name] for name in shown if name in OF_THIS_HOST}


def about(report: Report) -> str:
    """Return a sentence on what the columns are; empty without a board."""
    where = board(report)
    return f"Not measured on {where}: its latency, memory and energy are predicted above." if where else ""


def sides(report: Report) -> Sides | None:
    """Return both sides of the variant that was chosen, or of the one that was predicted for; None without a board."""
    where = predicted_for(report)
    rows = [row for row in report.rows if row.get("latency_p50", "predicted")]
    if not where or not rows:
        return None
    row = next((row for row in report.rows if row.role == "chosen"), rows[0])
    elsewhere = OF_THIS_HOST if board(report) else {}
    measured = {name: title for name, title in columns(report).items() if name not in elsewhere}
    predicted = {name: label(name) for name in names(report, "predicted", where)}
    return Sides(where, row.name, _numbers(row, measured, "measured"), _numbers(row, predicted, "predicted"))


def _numbers(row: Row, titles: dict[str, str], origin: str) -> tuple[tuple[str, str], ...]:
    return tuple((title, full(item)) for name, title in titles.items() if (item := row.get(name, origin)))
