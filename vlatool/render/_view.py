"""What a report holds, sorted for a reader; shared by all formats, so that they show the same in the same order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

from vlatool.measures import (
    ELEMENTS,
    FURTHER,
    HEADLINE,
    LAST_POSITION,
    MOTION,
    RECORDED_ACCURACY,
    Quantity,
    quantity_of,
)
from vlatool.measures.latency import LATENCY_P50, OF_LATENCY, latency_of_limit
from vlatool.measures.success import SUCCESS
from vlatool.measures.tables import MISSING_VALUES
from vlatool.render._format import cell, interval, is_usual, label, plain
from vlatool.report import ON_BOARD, Measurement, Report, Row

ROLES = {"subject": "measured", "within": "within limits", "outside": "outside limits"}
RANKING = "hwselect"
"""The kind of a report that ranks boards: its rows are not variants."""


@dataclass(frozen=True)
class Latency:
    """The latency that a chart shows, the limit on it when one was asked for, and what a drawing calls that."""

    quantity: Quantity
    limit: float | None
    word: str = "limit"


def ranks_boards(report: Report) -> bool:
    """Return whether the rows are boards, not variants."""
    return report.kind == RANKING


def measurements(report: Report, quantity: Quantity) -> list[Measurement | None]:
    """Return the measured number of a quantity, one for each row."""
    return [row.get(quantity) for row in report.rows]


def of_origin(report: Report, origin: str, where: str | None = None) -> Iterator[Measurement]:
    """Return the measurements of an origin, those of one place when it is given."""
    for row in report.rows:
        yield from (item for item in row.measurements if item.origin == origin and where in (None, item.where))


def quantities(report: Report, origin: str = "measured", where: str | None = None) -> list[Quantity]:
    """Return the quantities in the order of their first appearance."""
    return [quantity_of(name) for name in dict.fromkeys(item.name for item in of_origin(report, origin, where))]


def places(report: Report, origin: str) -> list[str]:
    """Return where the numbers of an origin were measured, or what they were predicted for."""
    return list(dict.fromkeys(item.where for item in of_origin(report, origin)))


def headline(report: Report) -> list[Quantity]:
    """Return the few measured quantities that decide, those that a limit names among them, each a column."""
    present = quantities(report)
    sections = (HEADLINE,) if SUCCESS in present else (HEADLINE, RECORDED_ACCURACY)
    decide = (each for each in present if each.section in sections or each.name in report.limits)
    return sorted(decide, key=lambda each: each.order)


def further(report: Report) -> list[Quantity]:
    """Return the measured quantities that neither the headline nor another table shows."""
    shown = [*headline(report), *percentiles(report), *motions(report)]
    rest = (each for each in quantities(report) if each not in shown and each.section != ELEMENTS)
    return sorted(rest, key=lambda each: each.order if each.section == FURTHER else LAST_POSITION)


def motions(report: Report) -> list[Quantity]:
    """Return the measured quantities that say how the variants move beside the baseline."""
    found = (each for each in quantities(report) if each.section == MOTION)
    return sorted(found, key=lambda each: (each.order, each.name))


def percentiles(report: Report) -> list[Quantity]:
    """Return the measured percentiles of the latency when there are enough of them for a table of their own."""
    present = quantities(report)
    found = [each for each in OF_LATENCY if each in present]
    return found if len(found) > 2 else []


def elements(report: Report) -> dict[str, list[Quantity]]:
    """Return ``error vs baseline`` -> its measured quantities, one for each element of an action."""
    groups: dict[str, list[Quantity]] = {}
    for each in quantities(report):
        if each.section == ELEMENTS:
            groups.setdefault(each.group, []).append(each)
    return groups


def processor(report: Report) -> str:
    """Return the processor of the machine that made the report, or nothing."""
    cpu = report.environment.get("cpu") or report.environment.get("processor") or ""
    if isinstance(cpu, Mapping):
        cpu = next((cpu[key] for key in ("model", "name", "brand") if cpu.get(key)), "")
    return plain(cpu)


def place(report: Report, where: str) -> str:
    """Return a place for a reader; ``this host`` gets its processor."""
    cpu = processor(report) if where == "this host" else ""
    return f"{plain(where)}: {cpu}" if cpu else plain(where)


def measured_where(report: Report) -> str:
    """Return where the numbers were measured, in words."""
    where = places(report, "measured")
    return "Measured on " + "; ".join(place(report, host) for host in where) if where else "Nothing was measured"


def brackets(report: Report, origin: str, where: str | None = None) -> str:
    """Return a sentence on what the ranges are; nothing when there are none of the usual coverage."""
    spans = [item for item in of_origin(report, origin, where) if interval(item)]
    usual = sum(is_usual(item) for item in spans)
    if not usual:
        return ""
    what = "95 % intervals" if origin == "measured" else "the model's 95 % error intervals"
    return f"Ranges are {what}{'' if usual == len(spans) else ' unless marked'}."


def notes(report: Report, origin: str, where: str | None = None) -> list[str]:
    """Return a line for each note: the labels of the numbers that carry it, and the note.

    Notes of measured numbers that could not be had are the reasons why, and stand elsewhere.
    """
    by_note: dict[str, dict[str, None]] = {}
    for item in of_origin(report, origin, where):
        if item.note and (item.known or origin == "predicted"):
            group = quantity_of(item.name).group
            words = f"{group} by dimension" if group else label(item.name)
            by_note.setdefault(plain(item.note), {})[words] = None
    return [f"{', '.join(labels)}: {note}" for note, labels in by_note.items()]


def missing_reasons(report: Report, shown: Callable[[str], bool], *, further: bool = False) -> list[str]:
    """Return a sentence for each reason for which numbers could not be had; variants are named unless it holds for all.

    Args:
        shown: Says of the name of a measurement whether its reason is asked for.
        further: Add what is not a measurement of a row, from its details.
    """
    missing = [(row, _missing(item), plain(item.note)) for row in report.rows for item in row.measurements
               if not item.known and shown(item.name)]  # fmt: skip
    for row in report.rows if further else ():
        records = row.details.get(MISSING_VALUES, ())
        missing += [(row, plain(record.get("what", "")), plain(record.get("why", ""))) for record in records]
    rows_of: dict[tuple[str, str], dict[str, None]] = {}
    for row, what, why in missing:
        rows_of.setdefault((what, why), {})[plain(row.name)] = None
    grouped: dict[tuple[str, str], list[str]] = {}
    for (what, why), rows in rows_of.items():
        whose = "" if len(rows) == len(report.rows) else f"{', '.join(rows)}, "
        grouped.setdefault((whose, why), []).append(what)
    return [f"{whose}{', '.join(what)}{f': {why}' if why else ''}" for (whose, why), what in grouped.items()]


def _missing(item: Measurement) -> str:
    return label(item.name) + (f", predicted for {plain(item.where)}" if item.origin == "predicted" else "")


def role(row: Row) -> str:
    """Return the role in words."""
    return ROLES.get(row.role, row.role)


def latency(report: Report) -> Latency:
    """Return which latency percentile the limit speaks of, and the limit.

    A benchmark at a rate (``hz``) without one has its period as the deadline, and so have several that are compared.
    What ``optimize`` was asked for is not a limit on this host when it is for another board.
    """
    present = quantities(report)
    for_board = quantities(report, "predicted") and report.kind == "optimize" and ON_BOARD not in report.environment
    for name, limit in () if for_board else report.limits.items():
        limited = latency_of_limit(name) if is_number(limit) else None
        if limited is not None and quantity_of(limited.name) in present:
            return Latency(quantity_of(limited.name), float(limit), "deadline" if "deadline" in name else "limit")
    rate = report.limits.get("hz")
    if report.kind in ("benchmark", "compare") and is_number(rate) and rate > 0:
        return Latency(LATENCY_P50, 1e3 / rate, "deadline")
    return Latency(LATENCY_P50, None)


def is_number(value: Any) -> TypeGuard[int | float]:
    """Say whether a value of a report is a number; a flag is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def accuracy(report: Report) -> Quantity | None:
    """Return the quantity that says how well the variants do their task; None when there is none."""
    recorded = sorted(
        (each for each in quantities(report) if each.section == RECORDED_ACCURACY), key=lambda each: each.order
    )
    known = (each for each in (SUCCESS, *recorded) if any(item and item.known for item in measurements(report, each)))
    return next(known, None)


def floor(report: Report, quantity: Quantity) -> float | None:
    """Return the least success that the limits allow: given, or the baseline's less the allowed drop."""
    for key, limit in report.limits.items():
        if quantity != SUCCESS or SUCCESS.name not in key or not is_number(limit):
            continue
        share = limit / 100 if key.endswith(("_points", "_percent")) else float(limit)
        if "drop" not in key:
            return share
        for row in report.rows:
            if row.role == "baseline" and (success := row.get(quantity)) and success.known:
                return success.value - share
    return None


def facts(environment: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return the environment as (dotted name, text) pairs."""
    pairs: list[tuple[str, str]] = []
    for key, content in environment.items():
        name = f"{prefix}{plain(key)}"
        pairs += facts(content, f"{name}.") if isinstance(content, Mapping) else [(name, cell(content))]
    return pairs
