"""Hold a candidate against a baseline: every claim of a gate, measured anew with both side by side."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from statistics import median
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import NamedRecording
from vlatool.gate.config import Gate
from vlatool.gate.evidence import Evidence
from vlatool.gate.inputs import AGREEMENT, Inputs
from vlatool.gate.plan import Need, Plan
from vlatool.gate.same import check
from vlatool.gate.timing_processes import Timed
from vlatool.gate.verdict import Outcome, Reason, Verdict, worst
from vlatool.machine.host import before_run
from vlatool.measurement.agreement import Agreement, measure_agreement
from vlatool.measurement.pairs import PairJob
from vlatool.measurement.rows import ran_rows
from vlatool.measurement.validity import busy, engine_findings, throttling, validity
from vlatool.measures import series, tables
from vlatool.measures.latency import LATENCY_P50
from vlatool.report import Finding, Report, Row
from vlatool.runtime.policy import refuse_findings
from vlatool.stage.base import Context, content_hash
from vlatool.stage.identity import with_identity
from vlatool.telemetry import Recorder, open_all

KIND = "gate"
SIDES = ("baseline", "candidate")
PERIOD_S = 1.0
"""Seconds between two looks at the board."""


def run_gate(candidate: Bundle, baseline: Bundle, gate: Gate, context: Context, seed: int | None = None) -> Report:
    """Examine every claim of a gate; what is cheap first.

    Args:
        candidate, baseline: bundles with graphs, of one spec.
        seed: seed of everything that is drawn: observations, noise, the order in which bundles are loaded and called.
            Fresh entropy when None, so that nobody can know it before; the report says it.

    Raises:
        BundleError: when a bundle has no graph, the two have other inputs or outputs, or a file was changed.
        DataError: when accuracy is claimed and there is nothing to measure it on.
        GraphError: when a bundle cannot be run, hangs, or computes another golden action than its own.
    """
    notes: list[str] = []
    context = replace(context, note=notes.append)
    check(candidate, baseline, gate)
    for bundle in (candidate, baseline):
        refuse_findings(bundle, gate.accept)
    host, plan = before_run(), gate.plan
    seed = secrets.randbits(32) if seed is None else seed
    data = None if plan.data is None else NamedRecording(plan.data, plan.names)
    inputs = Inputs(baseline, data, seed)
    paths = str(baseline.path), str(candidate.path)
    job = PairJob(*paths, plan.engine, plan.threads, plan.warmup, plan.pairs, plan.seconds, seed)
    timed = Timed(job, context, plan.timeout, inputs)
    evidence = Evidence(candidate, baseline, plan, context, inputs, timed, _agreement(timed, plan, inputs))
    results, findings = _examined(gate, evidence)
    if Need.TIMES in plan.needs:
        findings += tuple(replace(finding, effect="note") for finding in busy(host))
    name, records = candidate.manifest.name, dict(zip(SIDES, evidence.answers.records, strict=False))
    for side, record in records.items():
        findings += tuple(engine_findings(f"the {side}", record))
    row = _row("candidate", candidate, timed, results)
    row = replace(row, details={**row.details, tables.SETTINGS: _measured_with(evidence)})
    baseline_row = _row("baseline", baseline, timed, results)
    baseline_row, row = (
        replace(one, details={**one.details, **({tables.RAN: ran_rows(records[side])} if side in records else {})})
        for side, one in zip(SIDES, (baseline_row, row), strict=True)
    )
    rows = (with_identity(baseline_row, baseline), with_identity(row, candidate))
    return Report(KIND, f"Gate of {name}", worst(result.verdict.outcome for result in results).value,
                  (*_summary(name, results), f"{inputs.description()}."), rows,
                  command=context.command, environment=host, warnings=tuple(dict.fromkeys(notes)),
                  validity=validity(findings), findings=findings)  # fmt: skip


@dataclass(frozen=True)
class _Result:
    """A verdict, its title and its words."""

    title: str
    verdict: Verdict
    sentence: str


def _examined(gate: Gate, evidence: Evidence) -> tuple[list[_Result], tuple[Finding, ...]]:
    """Examine every claim, and watch the board while something is timed."""
    results: list[_Result] = []
    findings: tuple[Finding, ...] = ()
    for times, claims in groupby(gate.in_order, lambda claim: Need.TIMES in claim.needs):
        with Recorder(open_all() if times else (), PERIOD_S) as board:
            for claim in claims:
                found = claim.verdicts(evidence).items()
                results += (_Result(title, verdict, claim.sentence(verdict)) for title, verdict in found)
        findings += tuple(throttling(board.summary.throttling))
    return results, findings


def _agreement(timed: Timed, plan: Plan, inputs: Inputs) -> Agreement:
    """Load both bundles as a robot does, golden action and all, and ask both where a claim looks at their answers."""
    timed.context.progress("both bundles, on observations that are not recorded", None)
    if Need.AGREEMENT not in plan.needs:
        return measure_agreement(replace(timed.job, pairs=0, seconds=0.0), timed.timeout)
    job = replace(timed.job, pairs=plan.observations, seconds=plan.answer_seconds)
    with inputs.file(plan.observations, AGREEMENT) as path:
        return measure_agreement(replace(job, observations=str(path)), timed.timeout)


def _measured_with(evidence: Evidence) -> list[dict[str, Any]]:
    """Return what a reader needs to judge, or repeat, the gate: a row for each thing."""
    plan, inputs = evidence.plan, evidence.inputs
    table: dict[str, Any] = {"seed": inputs.seed, "threads": ", ".join(map(str, (plan.threads, *plan.also_threads)))}
    engines = ("engine of the baseline", "engine of the candidate")
    table |= dict(zip(engines, evidence.answers.engines, strict=True))
    table |= {
        f"recording {recording.path.name}": f"sha256:{content_hash(recording.path)}"
        for recording in inputs.recordings
        if recording.path.exists()
    }
    if Need.RECORDINGS in plan.needs and (data := evidence.recording_path) is not None and data.exists():
        table["evaluation data"] = f"sha256:{content_hash(data)}"
    return [{"what": what, "value": value} for what, value in table.items()]


def _row(name: str, bundle: Bundle, timed: Timed, results: Sequence[_Result]) -> Row:
    calls = timed.calls(name)
    measured = [LATENCY_P50.measurement(median(calls), samples=len(calls))] if calls else []
    raw = {series.LATENCY: calls} if calls else {}
    reason = f"{bundle.manifest.name}, {bundle.hash[:19]}"
    if name == "baseline":
        measured += [number for result in results for number in result.verdict.baseline]
        return Row(name, "baseline", reason, tuple(measured), raw)
    measured += [number for result in results for number in result.verdict.measurements]
    if calls:
        raw[series.LOG_RATIO] = [pairs.log_ratio for pairs in timed.pairs]
        raw[series.LOG_MEAN_RATIO] = [pairs.mean_log_ratio for pairs in timed.pairs]
    claims = [{"claim": result.title, "verdict": result.verdict.outcome.value, "found": result.sentence}
              for result in results]  # fmt: skip
    return Row(name, "subject", reason, tuple(measured), raw, {tables.CLAIMS: claims})


def _summary(name: str, results: Sequence[_Result]) -> tuple[str, ...]:
    """Return the result, then every claim in a sentence, those that failed first."""
    named = {outcome: ", ".join(result.title for result in results if result.verdict.outcome is outcome)
             for outcome in Outcome}  # fmt: skip
    first = {
        Outcome.PASS: f"{name} keeps to every claim: {named[Outcome.PASS]}.",
        Outcome.FAIL: f"{name} does not keep to: {named[Outcome.FAIL]}.",
        Outcome.INCONCLUSIVE: f"The samples cannot decide about {named[Outcome.INCONCLUSIVE]} of {name}.",
    }[worst(result.verdict.outcome for result in results)]
    no_reference = any(result.verdict.reason is Reason.REFERENCE_FAILS for result in results)
    if no_reference and not named[Outcome.FAIL]:
        first = f"Nothing is said about {name}, for the baseline is not a reference: it does not do its task."
    ordered = sorted(results, key=lambda result: list(Outcome).index(result.verdict.outcome))
    return (first, *(f"{each.title}: {each.verdict.outcome.value}: {each.sentence}." for each in ordered))
