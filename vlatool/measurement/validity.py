"""Validity of a measurement: findings beside the latencies, what they mean and what to do about them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from statistics import median
from typing import Any

from vlatool.files.printable import amount
from vlatool.measurement.answers import MAX_FRESH_RATIO
from vlatool.measurement.clock_drift import MAX_DRIFT, drift
from vlatool.measurement.interleaved import MAX_CALLS
from vlatool.measurement.jobs import LatencyJob
from vlatool.measurement.results import Benchmark, PolicyRun
from vlatool.report import Finding
from vlatool.runtime.engine_record import EngineRecord

SWITCHES_A_SECOND = 50.0
"""Involuntary context switches of a thread that has its processor for itself: a few in a second."""
MAX_STOLEN_SHARE = 0.01
LATER = 0.05
"""Share by which the last quarter may be slower than the first."""
FEWEST = 40
GROWTH_MB = 5.0
GROWTH = 0.05
BUSY, BUSY_SHARE = 0.15, 0.1
"""Processors that may be busy before the run: so many, and so many more for each that there is."""
suspect = partial(Finding, "suspect")


def findings(measured: Benchmark, job: LatencyJob, duration_is_sustained: bool = False) -> tuple[Finding, ...]:
    """Return what bears on the measurement, the worst first.

    Args:
        measured: what ``agent.measure`` returned for the job.
        duration_is_sustained: whether the run was meant to heat the board up: then throttling is its result.
    """
    seen = [
        *_answers(measured.policies),
        *_golden_findings(measured.policies),
        *_threads(measured, job),
        *busy(measured.host),
        *_contention(measured, job),
        *_clock(measured, duration_is_sustained),
        *_later(measured, job, duration_is_sustained),
        *_memory(measured),
        *_governor(measured.host),
        *_full(measured, job),
    ]
    order = ("invalid", "suspect", "note")
    return tuple(sorted(seen, key=lambda finding: order.index(finding.effect)))


def validity(seen: Sequence[Finding]) -> str:
    """Return ``invalid``, ``suspect`` or ``valid``: the worst effect."""
    effects = {finding.effect for finding in seen}
    return next((effect for effect in ("invalid", "suspect") if effect in effects), "valid")


def _answers(policies: Sequence[PolicyRun]) -> Iterator[Finding]:
    for policy in policies:
        answers, memory = policy.answers, policy.memory
        if answers and answers.strays:
            worst = answers.worst
            how = "not finite, or of another shape" if worst is None else f"relative difference up to {worst:.3g}"
            yield Finding(
                "invalid",
                f"{policy.name} answered {answers.strays} of {answers.looked} observations otherwise than in "
                f"an unhurried pass before ({how}, first in call {answers.first + 1})",
                "a fast wrong answer is not an inference: check engine and version, then the machine's memory",
            )
        if memory and memory.remembers:
            yield Finding(
                "invalid",
                f"{policy.name} takes {memory.ratio:.2f} times as long for observations that it has not seen "
                f"(at least {memory.low:.2f} times; allowed {MAX_FRESH_RATIO:g}): it answers repeated ones from memory",
                "measure without the cache, or with --no-answers if a robot's observations do repeat",
            )


def busy(host: Mapping[str, Any]) -> Iterator[Finding]:
    """Tell of other work right before the run."""
    taken, cores = host.get("processors_busy"), host.get("cores_online") or 1
    if taken is not None and taken > BUSY + BUSY_SHARE * cores:
        yield suspect(
            f"other work kept {taken:.1f} of {cores} processors busy: the latencies are those of a contended machine",
            "repeat on an idle machine; ratios within the run still compare, absolute values do not",
        )


def engine_findings(name: str, record: EngineRecord | None) -> Iterator[Finding]:
    """Tell of an engine that did not run a policy as asked."""
    for problem in record.problems if record else ():
        yield suspect(
            f"the engine did not run {name} as asked: {problem.rstrip('.')}",
            "use the engine that it was made for, or make a bundle for this engine and processor",
        )


def _golden_findings(policies: Sequence[PolicyRun]) -> Iterator[Finding]:
    for policy in policies:
        error = policy.golden_error
        if error is not None and error > policy.golden_explained:
            yield suspect(
                f"the golden action of {policy.name} is off by {error:.2g} (relative) on this machine; rounding "
                f"explains {policy.golden_explained:.2g}",
                "see what its engine and processor compute in: vlatool explain, vlatool doctor",
            )
        yield from engine_findings(policy.name, policy.record)
        if policy.engines and policy.answers is None:
            yield Finding("note", f"the answers of {policy.name} were not looked at (--no-answers)")


def _threads_and_processors(measured: Benchmark, job: LatencyJob) -> tuple[int, int]:
    """Return the threads of the engine, and the processors that they share."""
    usable = int(measured.host.get("cores") or 1)
    return job.threads, min(usable, len(job.limits.cpus) or usable, job.limits.cores or usable)


def _threads(measured: Benchmark, job: LatencyJob) -> Iterator[Finding]:
    threads, processors = _threads_and_processors(measured, job)
    if threads > processors:
        yield suspect(
            f"{threads} threads share {amount(processors, 'processor')}: they wait for each other",
            f"--threads {processors}, or fewer",
        )


def _contention(measured: Benchmark, job: LatencyJob) -> Iterator[Finding]:
    switches = measured.switches / max(measured.wall_s, 1e-9)
    threads, processors = _threads_and_processors(measured, job)
    if switches > SWITCHES_A_SECOND * threads and threads <= processors:
        yield suspect(
            f"other work took the processor from the measurement {switches:.0f} times in a second",
            "stop it, or keep processors free for the run (taskset, or benchmark --pin); ratios within the "
            "run still compare",
        )
    stolen = measured.telemetry.counters.get("process.machine_steal") if measured.telemetry else None
    seconds = stolen.seconds * (measured.host.get("cores") or 1) if stolen else 0.0
    if stolen and stolen.difference > MAX_STOLEN_SHARE * seconds:
        yield suspect(
            f"the host of this virtual machine took {stolen.difference / seconds:.1%} of its processors' time",
            "measure on the board itself, or on a machine that is not shared",
        )


def throttling(causes: Sequence[str], effect: str = "suspect") -> Iterator[Finding]:
    """Tell of a board that throttled, from what throttled it in words."""
    if causes:
        reason = f"the board was throttled: {'; '.join(causes)}"
        yield Finding(effect, reason, "cool it, or choose a power mode that it can hold")


def _clock(measured: Benchmark, sustained: bool) -> Iterator[Finding]:
    effect = "note" if sustained else "suspect"
    yield from throttling(measured.telemetry.throttling if measured.telemetry else (), effect)
    moved = drift(measured.canary_ms)
    if abs(moved) > MAX_DRIFT:
        yield Finding(
            effect,
            f"the processor became {_slower(moved)} from the first half of the run to the second (a fixed piece "
            "of work beside the policy)",
            "fix the clock (jetson_clocks, or the governor 'performance'), cool the board, or end what else runs",
        )


def _slower(share: float) -> str:
    return f"{abs(share):.0%} {'slower' if share > 0 else 'faster'}"


def _later(measured: Benchmark, job: LatencyJob, sustained: bool) -> Iterator[Finding]:
    """Tell of a policy alone that did not settle; several in turns slow down together, and their ratios stand."""
    policy, *others = measured.policies
    samples = policy.samples
    quarter = len(samples) // 4
    if quarter < FEWEST or sustained or others:
        return
    moved = median(samples[-quarter:]) / median(samples[:quarter]) - 1
    if abs(moved) > LATER:
        longer = "--duration" if job.rate else "--sustained"
        yield suspect(
            f"the last quarter of {policy.name} was {_slower(moved)} than the first",
            f"warm up longer (--warmup), or see how it goes on: {longer} 600",
        )


def _memory(measured: Benchmark) -> Iterator[Finding]:
    held = measured.telemetry.gauges.get("process.memory") if measured.telemetry else None
    values = held.values if held else ()
    third = len(values) // 3
    if third < 3:
        return
    before, after = median(values[third : 2 * third]), median(values[-third:])
    if after - before > max(GROWTH_MB, GROWTH * before):
        yield suspect(
            f"the process grew from {before:.0f} to {after:.0f} MB while it was measured",
            "see whether it goes on: --duration 600",
        )


def _full(measured: Benchmark, job: LatencyJob) -> Iterator[Finding]:
    for policy in measured.policies:
        if len(policy.at_s) == MAX_CALLS > job.iterations:
            yield Finding("note", f"{policy.name} ended after {MAX_CALLS:,} calls: every one of them is kept")


def _governor(host: Mapping[str, Any]) -> Iterator[Finding]:
    governor = host.get("governor")
    if governor and "performance" not in str(governor):
        yield Finding(
            "note",
            f"the governor is {governor}: the clock follows the load, so a loop that sleeps runs slower than this",
            "sudo cpupower frequency-set -g performance; on a Jetson: sudo jetson_clocks",
        )
