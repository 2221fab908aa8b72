"""Hold a candidate against a baseline: every claim of a gate, measured anew with both side by side."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import median
from typing import Any

from vlatool.accuracy.credibility import FAILS
from vlatool.bundle.bundle import Bundle
from vlatool.gate.claims import accuracy, answers, deadline, disturbed, growth, latency, motion, task_time, worst_task
from vlatool.gate.config import Gate, LatencyClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.inputs import AGREEMENT, Inputs
from vlatool.gate.result import ClaimResult, worst
from vlatool.gate.same import check
from vlatool.gate.timed import Timed
from vlatool.machine.host import before_run
from vlatool.measurement.agreement import Agreement, measure_agreement
from vlatool.measurement.pairs import PairJob
from vlatool.measurement.validity import busy, throttling, validity
from vlatool.report import Measurement, Report, Row
from vlatool.runtime.policy import refuse_findings
from vlatool.stage.base import Context, content_hash
from vlatool.telemetry import Recorder, open_all

KIND = "gate"
PERIOD_S = 1.0
"""Seconds between two looks at the board."""


def run_gate(candidate: Bundle, baseline: Bundle, gate: Gate, context: Context, seed: int | None = None) -> Report:
    """Examine every claim of a gate; what is cheap first.

    Args:
        candidate, baseline: Bundles with graphs, of one spec.
        gate: What is claimed.
        context: Progress and workers.
        seed: Of everything that is drawn: observations, noise, the order in which bundles are loaded and called. Fresh
            entropy when None, so that nobody can know it before; the report says it.

    Raises:
        BundleError: when a bundle has no graph, the two have other inputs or outputs, or a file was changed.
        DataError: when accuracy is claimed and there is nothing to measure it on.
        GraphError: when a bundle cannot be run, hangs, or computes another golden action than its own.
    """
    check(candidate, baseline, gate)
    for bundle in (candidate, baseline):
        refuse_findings(bundle, gate.accept)
    host = before_run()
    how = gate.latency or LatencyClaim()
    seed = secrets.randbits(32) if seed is None else seed
    inputs = Inputs(baseline, gate.accuracy.data if gate.accuracy else None, seed)
    paths = str(baseline.path), str(candidate.path)
    job = PairJob(*paths, how.engine, how.threads, how.warmup, how.pairs, how.seconds, seed)
    timed = Timed(job, context, how.timeout, inputs)
    agreement = _agreement(timed, gate, inputs)
    results: list[ClaimResult] = []
    if gate.size:
        results.append(growth.examine_size(candidate, baseline, gate.size))
    if gate.memory:
        results.append(growth.examine_memory(candidate, baseline, gate.memory, how, context, inputs))
    if gate.accuracy:
        episodes = Episodes(candidate, baseline, gate.accuracy, context, how.engine, gate.disturbed)
        results.append(accuracy.examine(candidate, baseline, gate.accuracy, context, how.engine, episodes))
        results += _of_episodes(episodes, gate)
    with Recorder(open_all(), PERIOD_S) as board:
        if gate.latency:
            results += latency.examine_all(timed, gate.latency)
        if gate.deadline:
            results.append(deadline.examine(timed, gate.deadline))
    if gate.answers:
        results.append(answers.examine(agreement, timed, gate.answers))
    seen = (*throttling(board.recorded.throttling), *(replace(finding, effect="note") for finding in busy(host)))
    seen = seen if gate.latency or gate.deadline else ()  # findings about times
    name = candidate.manifest.name
    row = _row("candidate", candidate, timed, results)
    row = replace(row, details={**row.details, "measured with": _measured_with(gate, inputs, agreement)})
    rows = (_row("baseline", baseline, timed, results), row)
    return Report(KIND, f"Gate of {name}", worst(result.verdict for result in results),
                  (*_summary(name, results), f"{inputs.told()}."), rows,
                  command=context.command, environment=host, warnings=tuple(dict.fromkeys(context.notes)),
                  validity=validity(seen), findings=seen)  # fmt: skip


def _of_episodes(episodes: Episodes, gate: Gate) -> Iterator[ClaimResult]:
    """Yield what the claims say that are about the closed-loop episodes."""
    if gate.motion:
        yield motion.examine(episodes, gate.motion)
    if gate.task_time:
        yield task_time.examine(episodes, gate.task_time)
    if gate.worst_task:
        yield worst_task.examine(episodes, gate.worst_task)
    if gate.disturbed:
        yield disturbed.examine(episodes, gate.disturbed)


def _agreement(timed: Timed, gate: Gate, inputs: Inputs) -> Agreement:
    """Load both bundles as a robot does, golden action and all, and ask both where answers are claimed."""
    claim = gate.answers
    timed.context.progress("both bundles, on observations that are not recorded", None)
    job = replace(timed.job, pairs=claim.observations if claim else 0, seconds=claim.seconds if claim else 0.0)
    if claim is None:
        return measure_agreement(job, timed.timeout)
    with inputs.file(claim.observations, AGREEMENT) as path:
        return measure_agreement(replace(job, observations=str(path)), timed.timeout)


def _measured_with(gate: Gate, inputs: Inputs, agreement: Agreement) -> list[dict[str, Any]]:
    """Return what a reader needs to judge, or repeat, the gate: a row for each thing."""
    how = gate.latency or LatencyClaim()
    table: dict[str, Any] = {"seed": inputs.seed, "threads": ", ".join(map(str, (how.threads, *how.also_threads)))}
    table |= dict(zip(("engine of the baseline", "engine of the candidate"), agreement.engines, strict=True))
    table |= {
        f"recording {recording.path.name}": f"sha256:{content_hash(recording.path)}"
        for recording in inputs.recordings
        if recording.path.exists()
    }
    if gate.accuracy and (data := accuracy.data_of(inputs.baseline, gate.accuracy)) is not None and data.exists():
        table["evaluation data"] = f"sha256:{content_hash(data)}"
    return [{"what": what, "value": value} for what, value in table.items()]


def _row(name: str, bundle: Bundle, timed: Timed, results: Sequence[ClaimResult]) -> Row:
    calls = timed.calls(name)
    measured = [Measurement("latency_p50", median(calls), "ms", samples=len(calls))] if calls else []
    raw = {"latency_ms": calls} if calls else {}
    reason = f"{bundle.manifest.name}, {bundle.hash[:19]}"
    if name == "baseline":
        measured += [number for result in results for number in result.baseline]
        return Row(name, "baseline", reason, tuple(measured), raw)
    measured += [number for result in results for number in result.measurements]
    if calls:
        raw["log_ratio"] = [pairs.log_ratio for pairs in timed.pairs]
        raw["log_mean_ratio"] = [pairs.mean_log_ratio for pairs in timed.pairs]
    claims = [{"claim": result.claim, "verdict": result.verdict, "found": result.sentence} for result in results]
    return Row(name, "subject", reason, tuple(measured), raw, {"claims": claims})


def _summary(name: str, results: Sequence[ClaimResult]) -> tuple[str, ...]:
    """Return the result, then every claim in a sentence, those that failed first."""
    order = ("fail", "inconclusive", "pass")
    named = {verdict: ", ".join(result.claim for result in results if result.verdict == verdict) for verdict in order}
    first = {
        "pass": f"{name} keeps to every claim: {named['pass']}.",
        "fail": f"{name} does not keep to: {named['fail']}.",
        "inconclusive": f"The samples cannot decide about {named['inconclusive']} of {name}.",
    }[worst(result.verdict for result in results)]
    if any(result.sentence.startswith(FAILS) for result in results) and not named["fail"]:
        first = f"Nothing is said about {name}, for the baseline is no reference: it does not do its task."
    ordered = sorted(results, key=lambda result: order.index(result.verdict))
    return (first, *(f"{result.claim}: {result.verdict}: {result.sentence}." for result in ordered))
