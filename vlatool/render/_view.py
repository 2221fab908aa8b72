"""What a report holds, sorted for a reader; shared by all formats, so that they show the same in the same order."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

from vlatool.render._format import cell, interval, is_usual, label, plain
from vlatool.report import ON_BOARD, Measurement, Report, Row

ACCURACY = ("success", "agreement", "agreement_expert", "agreement_baseline")
ERRORS = ("error", "error_expert", "error_baseline")
ROLES = {"subject": "measured", "within": "within limits", "outside": "outside limits"}
ERROR_OF_DIMENSION = re.compile(r"^(error\w*)\.(.+)$")
PERCENTILES = ("latency_p50", "latency_p90", "latency_p95", "latency_p99", "latency_p99.9", "latency_max")
ORDER = (
    "speedup", "throughput", "gmacs", "reach_share", "jitter", "deadline_misses",
    "age_p50", "age_p99", "age_max", "wakeup_p50", "wakeup_p99",
    "latency_start_p50", "latency_sustained_p50", "sustained_slowdown", "cold_start", "cpu",
    "size", "peak_rss", "steady_rss", "energy_per_action", "power_mean", "temperature_max",
)  # fmt: skip
"""The order in which the numbers of a benchmark are shown; others follow in the order of the report."""
ABSENT = "unmeasured"
"""The details table that says what could not be had; shown with the numbers that are NaN."""
BY_TASK, UNDER = "success by task", "under disturbances"
"""Tables of details that the section on motion draws, beside those against the baseline."""
SHOWN = "the episode that differs most"
AGAINST_BASELINE = "against the baseline"
OF_MOTION = ("task_speedup", "steps_ratio", "success_disturbed", "worst_task_drop")
"""Measurements of that section, beside the ratios of metrics."""
BOARDS = "hwselect"
"""The kind of a report that ranks boards: its rows are no variants."""
SHORT = {"success_drop": "drop", "latency_p50": "latency p50", "peak_rss": "memory"}


@dataclass(frozen=True)
class Latency:
    """The latency that a chart shows, the limit on it when one was asked for, and what a drawing calls that."""

    name: str
    limit: float | None
    word: str = "limit"


def ranks_boards(report: Report) -> bool:
    """Return whether the rows are boards, not variants."""
    return report.kind == BOARDS


def measured(report: Report, name: str) -> list[Measurement | None]:
    """Return the measured number of that name, one for each row."""
    return [row.get(name) for row in report.rows]


def of_origin(report: Report, origin: str, where: str | None = None) -> Iterator[Measurement]:
    """Return the measurements of an origin, those of one place when it is given."""
    for row in report.rows:
        yield from (item for item in row.measurements if item.origin == origin and where in (None, item.where))


def names(report: Report, origin: str = "measured", where: str | None = None) -> list[str]:
    """Return the names of measurements in the order of their first appearance."""
    return list(dict.fromkeys(item.name for item in of_origin(report, origin, where)))


def places(report: Report, origin: str) -> list[str]:
    """Return where the numbers of an origin were measured, or what they were predicted for."""
    return list(dict.fromkeys(item.where for item in of_origin(report, origin)))


def headline(report: Report) -> list[str]:
    """Return the names of the few measured numbers that decide."""
    present = names(report)
    accuracy = ["success", "success_drop"] if "success" in present else [*ACCURACY[1:], *ERRORS]
    deciding = ["latency_p50", "deadline_misses", "speedup", *accuracy, "size", "peak_rss"]
    return [name for name in deciding if name in present]


def other_names(report: Report) -> list[str]:
    """Return the measured names that neither the headline nor the error table shows."""
    shown = {*headline(report), *percentile_names(report), *motion_names(report)}
    others = [name for name in names(report) if name not in shown and not ERROR_OF_DIMENSION.match(name)]
    return sorted(others, key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))


def motion_names(report: Report) -> list[str]:
    """Return the names of the measured numbers that say how the variants move beside the baseline."""
    present = names(report)
    others = sorted(name for name in present if name.endswith(("_ratio", "_added")) and name not in OF_MOTION)
    return [*(name for name in OF_MOTION if name in present), *others]


def percentile_names(report: Report) -> list[str]:
    """Return the measured percentiles of the latency when there are enough of them for a table of their own."""
    present = names(report)
    percentiles = [name for name in PERCENTILES if name in present]
    return percentiles if len(percentiles) > 2 else []


def short(name: str) -> str:
    """Return the column title of a headline number."""
    return SHORT.get(name, label(name))


def error_groups(report: Report) -> dict[str, list[str]]:
    """Return ``error_baseline`` -> the full names of its measured dimensions."""
    groups: dict[str, list[str]] = {}
    for name in names(report):
        if group := ERROR_OF_DIMENSION.match(name):
            groups.setdefault(group[1], []).append(name)
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
            group = ERROR_OF_DIMENSION.match(item.name)
            words = f"{label(group[1])} by dimension" if group else label(item.name)
            by_note.setdefault(plain(item.note), {})[words] = None
    return [f"{', '.join(labels)}: {note}" for note, labels in by_note.items()]


def unmeasured(report: Report, shown: Callable[[str], bool], *, further: bool = False) -> list[str]:
    """Return a sentence for each reason for which numbers could not be had; variants are named unless it holds for all.

    Args:
        report: The report.
        shown: Says of the name of a measurement whether its reason is asked for.
        further: Add what is no measurement of a row, from its details.
    """
    missing = [(row, _missing(item), plain(item.note)) for row in report.rows for item in row.measurements
               if not item.known and shown(item.name)]  # fmt: skip
    for row in report.rows if further else ():
        records = row.details.get(ABSENT, ())
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
    What ``optimize`` was asked for is no limit on this host when it is for another board.
    """
    present = names(report)
    for_board = names(report, "predicted") and report.kind == "optimize" and ON_BOARD not in report.environment
    for name, limit in () if for_board else report.limits.items():
        if _is_number(limit) and name.endswith("_ms") and ("latency" in name or "deadline" in name):
            percentile = re.search(r"p\d+(\.\d+)?|max(?=_)", name.removeprefix("max_"))
            limited = f"latency_{percentile[0]}" if percentile else "latency_p50"
            if limited in present:
                return Latency(limited, float(limit), "deadline" if "deadline" in name else "limit")
    rate = report.limits.get("hz")
    if report.kind in ("benchmark", "compare") and _is_number(rate) and rate > 0:
        return Latency("latency_p50", 1e3 / rate, "deadline")
    return Latency("latency_p50", None)


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def accuracy(report: Report) -> str:
    """Return the name of the number that says how well the variants do their task; empty when there is none."""
    for name in (*ACCURACY, *ERRORS):
        if any(item is not None and math.isfinite(item.value) for item in measured(report, name)):
            return name
    return ""


def floor(report: Report, name: str) -> float | None:
    """Return the least success that the limits allow: given, or the baseline's less the allowed drop."""
    for key, limit in report.limits.items():
        if name != "success" or "success" not in key or not _is_number(limit):
            continue
        share = limit / 100 if key.endswith(("_points", "_percent")) else float(limit)
        if "drop" not in key:
            return share
        for row in report.rows:
            if row.role == "baseline" and (success := row.get(name)) and success.known:
                return success.value - share
    return None


def facts(environment: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return the environment as (dotted name, text) pairs."""
    pairs: list[tuple[str, str]] = []
    for key, content in environment.items():
        name = f"{prefix}{plain(key)}"
        pairs += facts(content, f"{name}.") if isinstance(content, Mapping) else [(name, cell(content))]
    return pairs
