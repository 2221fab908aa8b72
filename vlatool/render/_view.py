"""What a report holds, sorted for a reader; shared by all formats, so that they show the same in the same order."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    *(
        "speedup",
        "throughput",
        "jitter",
        "deadline_misses",
        "age_p50",
        "age_p99",
        "age_max",
        "wakeup_p50",
        "wakeup_p99",
    ),
    *("latency_start_p50", "latency_sustained_p50", "sustained_slowdown", "cold_start", "cpu"),
    *("size", "peak_rss", "steady_rss", "energy_per_action", "power_mean", "temperature_max"),
)
"""The order in which the numbers of a benchmark are shown; others follow in the order of the report."""
ABSENT = "unmeasured"
"""The details table that says what could not be had; shown with the numbers that are NaN."""
SHORT = {"success_drop": "drop", "latency_p50": "latency p50", "peak_rss": "memory"}


@dataclass(frozen=True)
class Latency:
    """The latency that a chart shows, and the limit on it when one was asked for."""

    name: str
    limit: float | None
    limit_name: str = ""

    @property
    def word(self) -> str:
        """What the limit is called in a drawing."""
        return "deadline" if "deadline" in self.limit_name else "limit"


def measured(report: Report, name: str) -> list[Measurement | None]:
    """Return the measured number of that name, one for each row."""
    return [row.get(name) for row in report.rows]


def names(report: Report, origin: str = "measured", where: str | None = None) -> list[str]:
    """Return the names of measurements in the order of their first appearance."""
    found: dict[str, None] = {}
    for row in report.rows:
        for item in row.measurements:
            if item.origin == origin and where in (None, item.where):
                found[item.name] = None
    return list(found)


def headline(report: Report) -> list[str]:
    """Return the names of the few measured numbers that decide."""
    present = names(report)
    accuracy = ["success", "success_drop"] if "success" in present else [*ACCURACY[1:], *ERRORS]
    wanted = ["latency_p50", "deadline_misses", "speedup", *accuracy, "size", "peak_rss"]
    return [name for name in wanted if name in present]


def other_names(report: Report) -> list[str]:
    """Return the measured names that neither the headline nor the error table shows."""
    shown = {*headline(report), *percentile_names(report)}
    return in_order(name for name in names(report) if name not in shown and not ERROR_OF_DIMENSION.match(name))


def percentile_names(report: Report) -> list[str]:
    """Return the measured percentiles of the latency when there are enough of them for a table of their own."""
    present = names(report)
    found = [name for name in PERCENTILES if name in present]
    return found if len(found) > 2 else []


def in_order(found: Iterable[str]) -> list[str]:
    """Return names of measurements in the order in which a reader asks for them."""
    return sorted(found, key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))


def short(name: str) -> str:
    """Return the column title of a headline number."""
    return SHORT.get(name, label(name))


def error_groups(report: Report) -> dict[str, list[str]]:
    """Return ``error_baseline`` -> the full names of its measured dimensions."""
    groups: dict[str, list[str]] = {}
    for name in names(report):
        if found := ERROR_OF_DIMENSION.match(name):
            groups.setdefault(found[1], []).append(name)
    return groups


def dimension(name: str) -> str:
    """Return ``dx`` of ``error_baseline.dx``."""
    return plain(name.partition(".")[2])


def places(report: Report, origin: str) -> list[str]:
    """Return where the numbers of an origin were measured, or what they were predicted for."""
    return list(dict.fromkeys(item.where for row in report.rows for item in row.measurements if item.origin == origin))


def processor(report: Report) -> str:
    """Return the processor of the machine that made the report, or nothing."""
    found = report.environment.get("cpu") or report.environment.get("processor") or ""
    if isinstance(found, Mapping):
        found = next((found[key] for key in ("model", "name", "brand") if found.get(key)), "")
    return plain(found)


def place(report: Report, where: str) -> str:
    """Return a place for a reader; ``this host`` gets its processor."""
    cpu = processor(report) if where == "this host" else ""
    return f"{plain(where)}: {cpu}" if cpu else plain(where)


def measured_where(report: Report) -> str:
    """Return the heading of the measured block."""
    found = places(report, "measured")
    return "Measured on " + "; ".join(place(report, where) for where in found) if found else "Nothing was measured"


def brackets(report: Report, origin: str, where: str | None = None) -> str:
    """Return a sentence on what the ranges are; nothing when there are none of the usual coverage."""
    spans = [
        item
        for row in report.rows
        for item in row.measurements
        if item.origin == origin and where in (None, item.where) and interval(item)
    ]
    usual = sum(is_usual(item) for item in spans)
    if not usual:
        return ""
    what = "95 % intervals" if origin == "measured" else "the model's 95 % error intervals"
    return f"Ranges are {what}{'' if usual == len(spans) else ' unless marked'}."


def notes(
    report: Report, origin: str, chosen: Callable[[Measurement], bool] = lambda item: True, where: str | None = None
) -> dict[str, list[str]]:
    """Return note -> the labels of the measurements that carry it."""
    found: dict[str, list[str]] = {}
    for row in report.rows:
        for item in row.measurements:
            if item.note and item.origin == origin and where in (None, item.where) and chosen(item):
                labels = found.setdefault(plain(item.note), [])
                group = ERROR_OF_DIMENSION.match(item.name)
                words = f"{label(group[1])} by dimension" if group else label(item.name)
                if words not in labels:
                    labels.append(words)
    return found


def matrix(
    report: Report, shown: Sequence[str], origin: str, where: str | None
) -> tuple[list[str], list[list[Measurement | None]]]:
    """Return the names of the variants that have such numbers, and for each number what each of them has."""
    found = [
        {item.name: item for item in row.measurements if item.origin == origin and where in (None, item.where)}
        for row in report.rows
    ]
    kept = [index for index, items in enumerate(found) if any(name in items for name in shown)]
    cells = [[found[index].get(name) for index in kept] for name in shown]
    return [report.rows[index].name for index in kept], cells


def unmeasured(report: Report, passed_over: Iterable[str] = ()) -> list[str]:
    """Return a sentence for each reason for which numbers could not be had; variants are named unless it holds for all.

    Args:
        report: The report.
        passed_over: Names of measurements whose reason stands elsewhere.
    """
    left = set(passed_over)
    found: dict[tuple[str, str], list[str]] = {}
    for row in report.rows:
        missing = [
            (
                f"{label(item.name)}{f', predicted for {plain(item.where)}' if item.origin == 'predicted' else ''}",
                item.note,
            )
            for item in row.measurements
            if not item.known and item.name not in left
        ]
        told = [(record.get("what", ""), record.get("why", "")) for record in row.details.get(ABSENT, ())]
        for what, why in [*missing, *told]:
            rows = found.setdefault((plain(what), plain(why)), [])
            if row.name not in rows:
                rows.append(row.name)
    grouped: dict[tuple[str, str], list[str]] = {}
    for (what, why), rows in found.items():
        whose = "" if len(rows) == len(report.rows) else f"{', '.join(plain(name) for name in rows)}, "
        grouped.setdefault((whose, why), []).append(what)
    return [f"{whose}{', '.join(what)}{f': {why}' if why else ''}" for (whose, why), what in grouped.items()]


def role(row: Row) -> str:
    """Return the role in words."""
    return ROLES.get(row.role, row.role)


def latency(report: Report) -> Latency:
    """Return which latency percentile the limit speaks of, and the limit.

    A benchmark at a rate (``hz``) without one has its period as the deadline, and so have several that are compared.
    What ``optimize`` was asked for is no limit on this host when it is for another board.
    """
    present = names(report)
    foretold = names(report, "predicted") and report.kind == "optimize" and ON_BOARD not in report.environment
    for name, wanted in () if foretold else report.limits.items():
        if _number(wanted) and name.endswith("_ms") and ("latency" in name or "deadline" in name):
            hit = re.search(r"p\d+(\.\d+)?|max(?=_)", name.removeprefix("max_"))
            chosen = f"latency_{hit[0]}" if hit else "latency_p50"
            if chosen in present:
                return Latency(chosen, float(wanted), plain(name))
    rate = report.limits.get("hz")
    if report.kind in ("benchmark", "compare") and _number(rate) and rate > 0:
        return Latency("latency_p50", 1e3 / rate, "deadline")
    return Latency("latency_p50", None)


def _number(wanted: Any) -> TypeGuard[int | float]:
    return isinstance(wanted, int | float) and not isinstance(wanted, bool)


def accuracy(report: Report) -> str:
    """Return the name of the number that says how well the variants do their task; empty when there is none."""
    for name in (*ACCURACY, *ERRORS):
        if any(item is not None and math.isfinite(item.value) for item in measured(report, name)):
            return name
    return ""


def floor(report: Report, name: str) -> float | None:
    """Return the least success that the limits allow: given, or the baseline's less the allowed drop."""
    for key, wanted in report.limits.items():
        if name != "success" or "success" not in key or isinstance(wanted, bool) or not isinstance(wanted, int | float):
            continue
        share = wanted / 100 if key.endswith(("_points", "_percent")) else float(wanted)
        if "drop" not in key:
            return share
        for row in report.rows:
            if row.role == "baseline" and (found := row.get(name)) and found.known:
                return found.value - share
    return None


def facts(environment: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return the environment as (dotted name, text) pairs."""
    found: list[tuple[str, str]] = []
    for key, content in environment.items():
        name = f"{prefix}{plain(key)}"
        if isinstance(content, Mapping):
            found += facts(content, f"{name}.")
        else:
            found.append((name, cell(content)))
    return found
