"""Reports that were made apart, as one: what differs between the machines, and what can be said across them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.compare.differences import circumstances, differences
from vlatool.compare.inputs import short_names
from vlatool.measures.latency import LATENCY_P50, SPEEDUP
from vlatool.report import VALIDITIES, Finding, Measurement, Report, Row

SPEEDUP_NOTE = "against {name}; the two runs were not interleaved"
THIS_HOST = "this host"


def side_by_side(paths: Sequence[Path], reports: Sequence[Report]) -> Report:
    """Return one report with the rows of all, the first row with a latency as the reference."""
    labels = short_names(paths)
    findings = [*differences(labels, reports), *_findings(labels, reports)]
    same = len({circumstances(report) for report in reports}) == 1 and reports[0].environment.get("cpu") is not None
    rows = _rows(labels, reports, same)
    limits = {
        name: value
        for name, value in reports[0].limits.items()
        if all(name in report.limits and report.limits[name] == value for report in reports)
    }
    return Report(
        "compare",
        f"{len(reports)} reports side by side",
        summary=_summary(rows, same),
        rows=tuple(rows),
        limits=limits,
        environment=_environment(labels, reports),
        warnings=tuple(
            f"{label}: {text}" for label, report in zip(labels, reports, strict=True) for text in report.warnings
        ),
        validity=_validity([report.validity for report in reports], findings),
        findings=tuple(findings),
    )


def _validity(judged: Sequence[str], findings: Sequence[Finding]) -> str:
    """Return the worst judgement; empty when a report was not judged and no finding is against it."""
    worst = max([*judged, *(finding.effect for finding in findings if finding.effect != "note")], key=VALIDITIES.index)
    return "" if worst == "valid" and "" in judged else worst


def _findings(labels: Sequence[str], reports: Sequence[Report]) -> list[Finding]:
    """Return the findings of the reports themselves, with their report's name."""
    return [
        replace(finding, reason=f"{label}: {finding.reason}")
        for label, report in zip(labels, reports, strict=True)
        for finding in report.findings
    ]


def _rows(labels: Sequence[str], reports: Sequence[Report], same: bool) -> list[Row]:
    """Return the rows of all reports; those of later ones lose the speed-up over their own baseline."""
    reference = _reference(reports[0])
    rows: list[Row] = []
    names = _row_names(labels, reports)
    for index, report in enumerate(reports):
        for row in report.rows:
            name = names[len(rows)]
            items = row.measurements
            if index:
                items = tuple(item for item in items if not (item.name == SPEEDUP.name and item.origin == "measured"))
                items += _speedup(row, reference, names[reports[0].rows.index(reference)]) if same and reference else ()
            if not same:
                where = f"{labels[index]}: {report.environment.get('cpu') or 'an unknown machine'}"
                items = tuple(replace(item, where=where) if item.where == THIS_HOST else item for item in items)
            role = "baseline" if row is reference else "failed" if row.role == "failed" else "subject"
            reason = row.reason if role == "failed" else ""
            rows.append(replace(row, name=name, role=role, reason=reason, measurements=items))
    return rows


def _reference(report: Report) -> Row | None:
    """Return the baseline of the first report, else its first row with a latency."""
    timed = [row for row in report.rows if math.isfinite(row.value(LATENCY_P50))]
    return next((row for row in timed if row.role == "baseline"), timed[0] if timed else None)


def _speedup(row: Row, reference: Row, name: str) -> tuple[Measurement, ...]:
    value, base = row.value(LATENCY_P50), reference.value(LATENCY_P50)
    if not math.isfinite(value) or value <= 0:
        return ()
    return (SPEEDUP.measurement(base / value, note=SPEEDUP_NOTE.format(name=name)),)


def _row_names(labels: Sequence[str], reports: Sequence[Report]) -> list[str]:
    """Return the names of the rows where they are unique; else those of the reports, with the row's where needed."""
    own = [row.name for report in reports for row in report.rows]
    if len(set(own)) == len(own):
        return own
    if all(len(report.rows) == 1 for report in reports):
        return list(labels)
    return [f"{label}: {row.name}" for label, report in zip(labels, reports, strict=True) for row in report.rows]


def _summary(rows: Sequence[Row], same: bool) -> tuple[str, ...]:
    timed = [row for row in rows if math.isfinite(row.value(LATENCY_P50))]
    if len(timed) < 2:
        return ()
    medians = ", ".join(f"{row.name} {row.value(LATENCY_P50):.3g} ms" for row in timed)
    apart = "The runs were not interleaved: what else ran on the machine may differ between them."
    other = "The reports are of different machines, or do not name theirs, so no speed-up is computed."
    return (f"Median latency: {medians}.", apart if same else other)


def _environment(labels: Sequence[str], reports: Sequence[Report]) -> dict[str, Any]:
    """Return the facts that all reports share, and what is left of each under its name."""
    first = dict(reports[0].environment)
    if all(dict(report.environment) == first for report in reports):
        return first
    shared = {
        key: value
        for key, value in first.items()
        if all(key in report.environment and report.environment[key] == value for report in reports)
    }
    own = {
        f"report {label}": {key: value for key, value in report.environment.items() if key not in shared}
        for label, report in zip(labels, reports, strict=True)
    }
    return {**shared, **own}
