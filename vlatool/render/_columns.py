"""What a report for a board says of it: what is predicted beside what was measured here, and whose milliseconds."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.measures import Quantity
from vlatool.measures.latency import LATENCY_P50
from vlatool.render._format import full, plain
from vlatool.render._view import headline, quantities
from vlatool.report import ON_BOARD, Report, Row

PREDICTING = ("optimize", "benchmark", "evaluate")
"""Kinds of reports that have predictions for a board beside what was measured."""


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
    boards = {item.where for row in report.rows if (item := row.get(LATENCY_P50, "predicted")) is not None}
    return boards.pop() if len(boards) == 1 and report.environment.get(ON_BOARD) not in boards else ""


def columns(report: Report) -> dict[Quantity, str]:
    """Return the columns of the variants, each with its title; for a board, milliseconds of this host come last, named.

    The other numbers hold anywhere, or are ratios.
    """
    shown, for_board = headline(report), bool(board(report))
    of_host = [each for each in shown if each.host_column and for_board]
    anywhere = {each: plain(each.column or each.words) for each in shown if each not in of_host}
    return anywhere | {each: each.host_column for each in of_host}


def about(report: Report) -> str:
    """Return a sentence on what the columns are; empty without a board."""
    where = board(report)
    return f"Not measured on {where}: its latency, memory and energy are predicted above." if where else ""


def sides(report: Report) -> Sides | None:
    """Return both sides of the variant that was chosen, or of the one that was predicted for; None without a board."""
    where = predicted_for(report)
    rows = [row for row in report.rows if row.get(LATENCY_P50, "predicted")]
    if not where or not rows:
        return None
    row = next((row for row in report.rows if row.role == "chosen"), rows[0])
    for_board = bool(board(report))
    measured = {each: title for each, title in columns(report).items() if not (each.host_column and for_board)}
    predicted = {each: plain(each.words) for each in quantities(report, "predicted", where)}
    return Sides(where, row.name, _numbers(row, measured, "measured"), _numbers(row, predicted, "predicted"))


def _numbers(row: Row, titles: dict[Quantity, str], origin: str) -> tuple[tuple[str, str], ...]:
    return tuple((title, full(item)) for each, title in titles.items() if (item := row.get(each, origin)))
