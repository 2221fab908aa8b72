"""Whether a measurement can be trusted: what was seen beside the latencies, what it means and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

from vlatool.benchmark._answers import REMEMBERS
from vlatool.benchmark._canary import MOVED, drift
from vlatool.benchmark._contest import MOST
from vlatool.report import Finding

SWITCHES_A_SECOND = 50.0
"""Involuntary context switches of a process that has its processor for itself: a few in a second."""
STOLEN = 0.01
LATER = 0.05
"""Share by which the last quarter may be slower than the first."""
FEWEST = 40
GROWTH_MB = 5.0
GROWTH = 0.05


def findings(found: Mapping[str, Any], duration_is_sustained: bool = False) -> tuple[Finding, ...]:
    """Return what bears on the measurement, the worst first.

    Args:
        found: What ``_agent.measure`` returned.
        duration_is_sustained: Whether the run was meant to heat the board up: then throttling is its result.
    """
    seen = [
        *_answers(found["policies"]),
        *busy(found.get("host") or {}),
        *_contended(found),
        *_clock(found, duration_is_sustained),
        *_later(found["policies"], duration_is_sustained),
        *_memory(found),
        *_governor(found.get("host") or {}),
        *_full(found["policies"]),
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
            yield Finding(
                "invalid",
                f"{policy['name']} answered {answers['strays']} of {answers['looked']} observations otherwise than in "
                f"an unhurried pass before (relative difference up to {answers['worst']:.3g}, first in call "
                f"{answers['first'] + 1})",
                "a fast wrong answer is no inference: check the engine and its version, then the memory of the machine",
            )
        if memory and memory["remembers"]:
            yield Finding(
                "invalid",
                f"{policy['name']} takes {memory['ratio']:.2f} times as long for observations that it has not seen "
                f"(at least {memory['low']:.2f} times; allowed {REMEMBERS:g}): it answers repeated ones from memory",
                "measure without the cache, or with --no-check if a robot's observations do repeat",
            )


def busy(host: Mapping[str, Any]) -> Iterator[Finding]:
    """Tell of other work before the run: the load average says more than this process can have caused."""
    load, cores = host.get("load_average"), host.get("cores")
    if load and cores and load[0] > max(1.5, 0.75 * cores):
        yield Finding(
            "suspect",
            f"this host was busy (load {load[0]:.1f} on {cores} cores): the latencies are those of a contended machine",
            "repeat on an idle machine; ratios within the run still compare, absolute values do not",
        )


def _contended(found: Mapping[str, Any]) -> Iterator[Finding]:
    wall = max(float(found["wall_s"]), 1e-9)
    counters = (found.get("telemetry") or {}).get("counters", {})
    stolen = counters.get("process.machine_steal")
    cores = (found.get("host") or {}).get("cores") or 1
    switches = float(found["switches"]) / wall
    if switches > SWITCHES_A_SECOND:
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


def _later(policies: Sequence[Mapping[str, Any]], sustained: bool) -> Iterator[Finding]:
    for policy in policies:
        samples = [value for block in policy["blocks_ms"] for value in block]
        quarter = len(samples) // 4
        if quarter < FEWEST or sustained:
            continue
        first, last = median(samples[:quarter]), median(samples[-quarter:])
        if abs(last / first - 1) > LATER:
            word = "slower" if last > first else "faster"
            yield Finding(
                "suspect",
                f"the last quarter of {policy['name']} was {abs(last / first - 1):.0%} {word} than the first",
                "warm up longer (--warmup), or see how it goes on: --sustained 600",
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


def _full(policies: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    for policy in policies:
        if len(policy["at_s"]) == MOST:
            yield Finding("note", f"{policy['name']} ended after {MOST:,} calls: every one of them is kept")


def _governor(host: Mapping[str, Any]) -> Iterator[Finding]:
    governor = host.get("governor")
    if governor and "performance" not in str(governor):
        yield Finding(
            "note",
            f"the governor is {governor}: the clock follows the load, so a loop that sleeps runs slower than this",
            "sudo cpupower frequency-set -g performance; on a Jetson: sudo jetson_clocks",
        )
