"""Reports that were made apart, as one: what differs between the machines, and what can be said across them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.compare.inputs import short_names
from vlatool.measures.latency import LATENCY_P50, SPEEDUP
from vlatool.measures.tables import ENGINE
from vlatool.report import VALIDITIES, Finding, Measurement, Report, Row

SPEEDUP_NOTE = "against {name}; the two runs were not interleaved"
THIS_HOST = "this host"
MACHINE = ("cpu", "architecture", "board", "cores", "cpu_quota")
CLOCKS = ("governor", "clock_min_mhz", "clock_max_mhz", "turbo")
RUN = ("rate_hz", "pin", "cores", "memory_limit_mb")
ENGINES = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-openvino", "openvino", "tensorrt", "torch")


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


def differences(labels: Sequence[str], reports: Sequence[Report]) -> list[Finding]:
    """Return what makes the reports hard to compare: other machine, engine, threads or clocks."""
    machines, clocks = ([_facts(report, keys) for report in reports] for keys in (MACHINE, CLOCKS))
    runs = [_run(report) for report in reports]
    groups = (
        ("The machines differ", "repeat the runs on one machine", machines),
        ("The versions differ", "measure again with the same versions", [_versions(report) for report in reports]),
        ("The numbers of threads differ", "measure with the same --threads", [_threads(report) for report in reports]),
        ("The clocks were set differently", "set the same governor and clocks", clocks),
        ("The runs differ", "measure with the same --rate, --pin and limits", runs),
        ("The engines differ", "that may be what is compared; else measure with the same --engine", _engines(reports)),
    )
    findings = []
    for what, remedy, facts in groups:
        keys = dict.fromkeys(key for fact in facts for key in fact)
        differing = [text for key in keys if (text := _differs(key, labels, facts))]
        if differing:
            engines = "engines" in what
            how = remedy if engines else f"{remedy}, or compare the bundles themselves"
            findings.append(Finding("note" if engines else "suspect", f"{what}: {'; '.join(differing)}", how))
    return findings


def _differs(key: str, labels: Sequence[str], facts: Sequence[Mapping[str, Any]]) -> str:
    """Return ``cores 4 (a), 8 (b)``; nothing when all reports that know it agree."""
    by_value: dict[str, list[str]] = {}
    for label, fact in zip(labels, facts, strict=True):
        if fact.get(key) is not None:
            by_value.setdefault(_text(fact[key]), []).append(label)
    if len(by_value) < 2:
        return ""
    values = [f"{value} ({', '.join(names)})" for value, names in by_value.items()]
    return f"{key.replace('_', ' ')} {', '.join(values)}"


def _text(value: Any) -> str:
    """Return a fact as text; clocks that all cores share are one number."""
    if isinstance(value, list):
        return " ".join(dict.fromkeys(f"{item:g}" if isinstance(item, float) else str(item) for item in value))
    return str(value)


def _facts(report: Report, keys: Sequence[str]) -> dict[str, Any]:
    return {key: report.environment.get(key) for key in keys}


def _versions(report: Report) -> dict[str, Any]:
    versions = report.environment.get("versions")
    return {name: versions.get(name) for name in ENGINES} if isinstance(versions, Mapping) else {}


def _run(report: Report) -> dict[str, Any]:
    """Return how a report was measured; ``none`` for what was not asked for, so that it differs from what was."""
    run = report.environment.get("run")
    return {key: run.get(key, "none") for key in RUN} if isinstance(run, Mapping) else {}


def _engines(reports: Sequence[Report]) -> list[dict[str, Any]]:
    """Return the engines of each report; engines that one report compares are not a difference between reports."""
    used = [
        sorted({str(record["engine"]) for row in report.rows for record in row.details.get(ENGINE, ())})
        for report in reports
    ]
    return [{"engine": ", ".join(names)} if names else {} for names in used]


def _threads(report: Report) -> dict[str, Any]:
    run = report.environment.get("run")
    if isinstance(run, Mapping) and run.get("threads") is not None:
        return {"threads": run["threads"]}
    recorded = [record.get("threads") for row in report.rows for record in row.details.get(ENGINE, ())]
    known = {threads for threads in recorded or [report.environment.get("threads")] if threads is not None}
    return {"threads": sorted(known, key=str)} if known else {}


def circumstances(report: Report) -> tuple[str, str]:
    """Return machine and pace: latencies from other ones give no speed-up."""
    return str(_facts(report, MACHINE)), str(_run(report).get("rate_hz", "none"))
