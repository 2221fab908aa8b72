"""Whether a measurement can be trusted: what was seen beside the latencies, what it means and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

from vlatool.measurement.answers import REMEMBERS
from vlatool.measurement.clock_drift import MOVED, drift
from vlatool.measurement.interleaved import MOST
from vlatool.measurement.rows import samples_of
from vlatool.report import Finding

SWITCHES_A_SECOND = 50.0
"""Involuntary context switches of a thread that has its processor for itself: a few in a second."""
STOLEN = 0.01
LATER = 0.05
"""Share by which the last quarter may be slower than the first."""
FEWEST = 40
GROWTH_MB = 5.0
GROWTH = 0.05
BUSY, BUSY_SHARE = 0.15, 0.1
"""Processors that may be busy before the run: so many, and so many more for each that there is."""
GOLDEN = 1e-2
"""Relative difference of the golden action that another processor's rounding explains in int8."""


def findings(found: Mapping[str, Any], duration_is_sustained: bool = False) -> tuple[Finding, ...]:
    """Return what bears on the measurement, the worst first.

    Args:
        found: What ``_agent.measure`` returned.
        duration_is_sustained: Whether the run was meant to heat the board up: then throttling is its result.
    """
    seen = [
        *_answers(found["policies"]),
        *_golden(found["policies"]),
        *_threads(found),
        *busy(found.get("host") or {}),
        *_contended(found),
        *_clock(found, duration_is_sustained),
        *_later(found, duration_is_sustained),
        *_memory(found),
        *_governor(found.get("host") or {}),
        *_full(found),
    ]
    order = ("invalid", "suspect", "note")
    return tuple(sorted(seen, key=lambda each: order.index(each.effect)))


def validity(seen: Sequence[Finding]) -> str:
    """Return ``invalid``, ``suspect`` or ``valid``: the worst effect."""
    effects = {each.effect for each in seen}
    return next((effect for effect in ("invalid", "suspect") if effect in effects), "valid")


def _answers(policies: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    for policy in policies:
        answers, memory = policy.get("answers"), policy.get("memory")
        if answers and answers["strays"]:
            worst = answers["worst"]
            how = "not finite, or of another shape" if worst is None else f"relative difference up to {worst:.3g}"
            yield Finding(
                "invalid",
                f"{policy['name']} answered {answers['strays']} of {answers['looked']} observations otherwise than in "
                f"an unhurried pass before ({how}, first in call {answers['first'] + 1})",
                "a fast wrong answer is no inference: check the engine and its version, then the memory of the machine",
            )
        if memory and memory["remembers"]:
            yield Finding(
                "invalid",
                f"{policy['name']} takes {memory['ratio']:.2f} times as long for observations that it has not seen "
                f"(at least {memory['low']:.2f} times; allowed {REMEMBERS:g}): it answers repeated ones from memory",
                "measure without the cache, or with --no-answers if a robot's observations do repeat",
            )


def busy(host: Mapping[str, Any]) -> Iterator[Finding]:
    """Tell of other work right before the run."""
    taken, cores = host.get("processors_busy"), host.get("cores_online") or 1
    if taken is not None and taken > BUSY + BUSY_SHARE * cores:
        yield Finding(
            "suspect",
            f"other work kept {taken:.1f} of {cores} processors busy: the latencies are those of a contended machine",
            "repeat on an idle machine; ratios within the run still compare, absolute values do not",
        )


def _golden(policies: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    for policy in policies:
        error = policy.get("golden_error")
        if error is not None and error > GOLDEN:
            yield Finding(
                "suspect",
                f"the golden action of {policy['name']} is off by {error:.2g} (relative) on this machine",
                "see what its engine and processor compute in: vlatool explain, vlatool doctor",
            )
        if policy.get("engines") and policy.get("answers") is None:
            yield Finding("note", f"the answers of {policy['name']} were not looked at (--no-answers)")


def _crowded(found: Mapping[str, Any]) -> tuple[int, int]:
    """Return the threads of the engine, and the processors that they share."""
    job, host = found.get("job") or {}, found.get("host") or {}
    limits = job.get("limits") or {}
    usable = int(host.get("cores") or 1)
    pinned = len(limits.get("cpus") or ()) or usable
    return int(job.get("threads") or 1), min(usable, pinned, int(limits.get("cores") or usable))


def _threads(found: Mapping[str, Any]) -> Iterator[Finding]:
    threads, processors = _crowded(found)
    if threads > processors:
        yield Finding(
            "suspect",
            f"{threads} threads share {processors} processor{'s' if processors > 1 else ''}: they wait for each other",
            f"--threads {processors}, or fewer",
        )


def _contended(found: Mapping[str, Any]) -> Iterator[Finding]:
    wall = max(float(found["wall_s"]), 1e-9)
    counters = (found.get("telemetry") or {}).get("counters", {})
    stolen = counters.get("process.machine_steal")
    cores = (found.get("host") or {}).get("cores") or 1
    switches = float(found["switches"]) / wall
    threads, processors = _crowded(found)
    if switches > SWITCHES_A_SECOND * threads and threads <= processors:
        yield Finding(
            "suspect",
            f"other work took the processor from the measurement {switches:.0f} times in a second",
            "stop it, or keep processors free for the run: --pin; ratios within the run still compare",
        )
    if stolen and stolen["difference"] > STOLEN * stolen["seconds"] * cores:
        share = stolen["difference"] / (stolen["seconds"] * cores)
        yield Finding(
            "suspect",
            f"the host of this virtual machine took {share:.1%} of its processors' time",
            "measure on the board itself, or on a machine that is not shared",
        )


def throttled(causes: Sequence[str], effect: str = "suspect") -> Iterator[Finding]:
    """Tell of a board that throttled, from what throttled it in words."""
    if causes:
        told = "; ".join(causes)
        yield Finding(effect, f"the board was throttled: {told}", "cool it, or choose a power mode that it can hold")


def _clock(found: Mapping[str, Any], sustained: bool) -> Iterator[Finding]:
    telemetry = found.get("telemetry") or {}
    yield from throttled(telemetry.get("throttling") or (), "note" if sustained else "suspect")
    moved = drift(found.get("canary_ms") or ())
    if abs(moved) > MOVED:
        word = "slower" if moved > 0 else "faster"
        yield Finding(
            "note" if sustained else "suspect",
            f"the processor became {abs(moved):.0%} {word} from the first half of the run to the second (a fixed piece "
            "of work beside the policy)",
            "fix the clock (jetson_clocks, or the governor 'performance'), cool the board, or end what else runs",
        )


def _later(found: Mapping[str, Any], sustained: bool) -> Iterator[Finding]:
    """Tell of a policy alone that did not settle; several in turns slow down together, and their ratios stand."""
    policy, *others = found["policies"]
    samples = samples_of(policy)
    quarter = len(samples) // 4
    if quarter < FEWEST or sustained or others:
        return
    first, last = median(samples[:quarter]), median(samples[-quarter:])
    if abs(last / first - 1) > LATER:
        word = "slower" if last > first else "faster"
        longer = "--duration" if (found.get("job") or {}).get("rate") else "--sustained"
        yield Finding(
            "suspect",
            f"the last quarter of {policy['name']} was {abs(last / first - 1):.0%} {word} than the first",
            f"warm up longer (--warmup), or see how it goes on: {longer} 600",
        )


def _memory(found: Mapping[str, Any]) -> Iterator[Finding]:
    held = (found.get("telemetry") or {}).get("gauges", {}).get("process.memory")
    values = list(held["values"]) if held else []
    third = len(values) // 3
    if third < 3:
        return
    before, after = median(values[third : 2 * third]), median(values[-third:])
    if after - before > max(GROWTH_MB, GROWTH * before):
        yield Finding(
            "suspect",
            f"the process grew from {before:.0f} to {after:.0f} MB while it was measured",
            "see whether it goes on: --duration 600",
        )


def _full(found: Mapping[str, Any]) -> Iterator[Finding]:
    asked = (found.get("job") or {}).get("iterations", MOST)
    for policy in found["policies"]:
        if len(policy["at_s"]) == MOST > asked:
            yield Finding("note", f"{policy['name']} ended after {MOST:,} calls: every one of them is kept")


def _governor(host: Mapping[str, Any]) -> Iterator[Finding]:
    governor = host.get("governor")
    if governor and "performance" not in str(governor):
        yield Finding(
            "note",
            f"the governor is {governor}: the clock follows the load, so a loop that sleeps runs slower than this",
            "sudo cpupower frequency-set -g performance; on a Jetson: sudo jetson_clocks",
        )
