"""What differs between the machines, versions and settings of reports, so that their numbers are hard to compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vlatool.measures.tables import ENGINE
from vlatool.report import Finding, Report

MACHINE = ("cpu", "architecture", "board", "cores", "cpu_quota")
CLOCKS = ("governor", "clock_min_mhz", "clock_max_mhz", "turbo")
RUN = ("rate_hz", "pin", "cores", "memory_limit_mb")
ENGINES = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-openvino", "openvino", "tensorrt", "torch")


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
