"""The rows of a report from the result of a benchmark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np

from vlatool.measurement.cold_start import PARTS, ColdStart
from vlatool.measurement.duty_cycle import duty_measurements, duty_table
from vlatool.measurement.interleaved import latency_measurements, percentile_measurements, speedup_of
from vlatool.measurement.paced import is_overloaded, paced_measurements
from vlatool.measurement.results import Benchmark, PolicyRun
from vlatool.measures import latency, resources, series
from vlatool.measures import tables as titles
from vlatool.measures.actions import GOLDEN_ERROR
from vlatool.report import Measurement
from vlatool.runtime.engine_record import EngineRecord
from vlatool.telemetry import DEGREE, THROTTLE, Absent, Summary

ENERGY_S = 10.0
"""Seconds below which the energy of a run says little (MLPerf Tiny: runs of 10 s)."""
OWN_COUNTERS = ("process.cpu", "process.involuntary_switches")
"""Counters that the measurements hold over exactly the timed part."""
WINDOW = 0.1
"""Share of a sustained run that is its start, and its end."""


def measurements(
    measured: Benchmark, policy: PolicyRun, reference: PolicyRun | None, rate: float, duty_rate: float = 0.0
) -> list[Measurement]:
    """Return the numbers of one policy.

    Args:
        measured: result of the whole run.
        policy: one of its policies.
        reference: policy that its speed is compared with; None when it ran alone.
        rate: ticks in a second; 0 for calls back to back.
        duty_rate: rate of the calls that a duty cycle compares with others, in Hz.
    """
    return [*_timed(measured, policy, reference, rate), *duty_measurements(policy.duty, duty_rate)]


def _timed(measured: Benchmark, policy: PolicyRun, reference: PolicyRun | None, rate: float) -> list[Measurement]:
    samples, pace = policy.samples, policy.pace
    most = math.inf if not pace else 0.0 if is_overloaded(pace, len(samples)) else pace.effective_sample_size
    seconds = len(samples) / rate if pace else None
    numbers = latency_measurements(samples, refusals=reference is None, most=most, seconds=seconds)
    if reference is not None:
        return [*numbers, speedup_of(policy.blocks_ms, reference.blocks_ms, reference.name), *cold_rows(policy)]
    if pace:
        note = "from the moment at which the tick was due"
        numbers = [replace(number, note=number.note or note) for number in numbers]
        numbers += paced_measurements(pace, len(samples), rate)
    else:
        rate_of_calls = 1e3 / float(np.mean(samples))
        numbers.append(latency.THROUGHPUT.measurement(rate_of_calls, samples=len(samples), note="back to back"))
    spread = float(np.subtract(*np.percentile(samples, [75, 25])))
    note = "between the quartiles of the latency"
    numbers.append(latency.JITTER.measurement(spread, samples=len(samples), note=note))
    busy = measured.cpu_s / max(measured.wall_s, 1e-9)
    numbers.append(resources.CPU.measurement(busy, note="user and system time of the process over the run"))
    board = _board(measured, pace.inferences if pace else len(samples))
    return [*numbers, *board, *_golden(policy), *cold_rows(policy)]


def _board(measured: Benchmark, actions: int) -> list[Measurement]:
    """Return power, energy and the highest temperature, where the board tells them."""
    telemetry = measured.telemetry
    if telemetry is None:
        return []
    numbers = []
    for energy in telemetry.energy[:1]:
        note = f"{energy.label} ({energy.source}), idle power included"
        numbers.append(resources.POWER_MEAN.measurement(energy.mean_w, samples=energy.samples, note=note))
        if energy.seconds >= ENERGY_S:
            joules = energy.mean_w * (measured.ended_s - measured.begun_s)
            numbers.append(resources.ENERGY_PER_ACTION.measurement(joules / actions, samples=actions, note=note))
        else:
            short = f"the run took {energy.seconds:.1f} s; pass --duration {ENERGY_S:g} or more"
            numbers.append(resources.ENERGY_PER_ACTION.measurement(math.nan, note=short))
    if hot := [(gauge.max, name) for name, gauge in telemetry.gauges.items() if gauge.unit == DEGREE]:
        value, name = max(hot)
        numbers.append(resources.TEMPERATURE_MAX.measurement(value, note=name))
    return numbers


def _golden(policy: PolicyRun) -> list[Measurement]:
    note = "relative difference of the golden action from the recorded one"
    error = policy.golden_error
    return [] if error is None else [GOLDEN_ERROR.measurement(error, samples=1, note=note)]


def cold_rows(policy: PolicyRun) -> list[Measurement]:
    """Return the cold start and the memory of fresh processes."""
    starts = policy.cold
    if policy.cold_error:
        return [latency.COLD_START.measurement(math.nan, note=policy.cold_error)]
    if not starts:
        return []
    fresh = f"fresh process; median of {len(starts)}"
    values = (
        (resources.PEAK_RSS, f"import, load, inferences in a {fresh}", [start.peak_rss_mb for start in starts]),
        (resources.STEADY_RSS, f"after some inferences in a {fresh}",
         [[*start.rss_mb.values()][-1] for start in starts]),
        (latency.COLD_START, f"start of the process to the first action, its files in the page cache; {fresh}",
         [start.total_ms for start in starts]),
    )  # fmt: skip
    return [quantity.measurement(median(samples), samples=len(starts), note=note) for quantity, note, samples in values]


def sustained_rows(samples: Sequence[float]) -> list[Measurement]:
    """Return the median at the start of a long run and at its end, each with its bound, and their ratio."""
    count = max(1, int(WINDOW * len(samples)))
    ends = []
    parts = ((latency.LATENCY_START, "first", samples[:count]), (latency.LATENCY_SUSTAINED, "last", samples[-count:]))
    for which, position, part in parts:
        (middle,) = percentile_measurements(which, part, (50.0,))
        ends.append(replace(middle, note=f"median of the {position} {100 * WINDOW:g} % of the run"))
    slowdown = ends[1].value / ends[0].value
    note = "end over start of the run"
    return [*ends, latency.SUSTAINED_SLOWDOWN.measurement(slowdown, samples=2 * count, note=note)]


def raw(measured: Benchmark, policy: PolicyRun, alone: bool) -> dict[str, list[float]]:
    """Return every sample: latencies, when each call began, and, of a run alone, what the board told meanwhile."""
    taken = {series.LATENCY: policy.samples, series.START_TIMES: list(policy.at_s)}
    if not alone or measured.telemetry is None:
        return taken
    moments: list[float] = []
    for name, gauge in measured.telemetry.gauges.items():
        times = [round(when - measured.begun_s, 3) for when in gauge.times]
        taken |= {series.READING.name(name): list(gauge.values), series.READING_TIMES.name(name): times}
        if gauge.unit == THROTTLE:
            moments += [when for when, value in zip(times, gauge.values, strict=True) if value]
    return {**taken, **({series.THROTTLE_TIMES: sorted(moments)} if moments else {})}


def tables(measured: Benchmark, policy: PolicyRun, alone: bool) -> dict[str, list[dict[str, Any]]]:
    """Return what belongs to a policy as tables: engine, phases, memory and cold start by part, telemetry."""
    details: dict[str, list[dict[str, Any]]] = {}
    if policy.engines:
        details[titles.ENGINE] = [
            {"graph": graph.graph, "engine": graph.engine, "version": graph.version, "providers": graph.providers,
             "computes in": graph.computes_in, "MACs in": graph.macs_in}
            for graph in policy.engines
        ]  # fmt: skip
    if policy.record:
        details[titles.RAN] = ran_rows(policy.record)
    if policy.phases:
        details[titles.PHASES] = [
            {"phase": phase.name, "calls": phase.calls, "p50 ms": phase.p50_ms, "share %": phase.share_percent}
            for phase in policy.phases
        ]
    if policy.duty:
        details[titles.DUTY_CYCLE] = duty_table(policy.duty)
    if policy.cold:
        details |= {titles.MEMORY_PARTS: _memory_parts(policy.cold), titles.START_PARTS: _start_parts(policy.cold)}
    if alone and measured.telemetry:
        details |= _telemetry(measured.telemetry)
    return details


def ran_rows(record: EngineRecord) -> list[dict[str, Any]]:
    """Return a row for each graph, provider and precision: nodes of the provider, share of the multiply-accumulates."""
    where = {"device": record.device, "driver": record.driver, "power mode": record.power_mode}
    return [
        {"graph": graph.graph, "provider": share.provider, "nodes": share.nodes, "precision": precision,
         "MACs %": round(100 * macs, 1), "promised %": round(100 * graph.promised.get(precision, 0.0), 1), **where}
        for graph in record.graphs
        for share in graph.shares
        for precision, macs in (share.macs or {"": 0.0}).items()
    ]  # fmt: skip


def _memory_parts(starts: Sequence[ColdStart]) -> list[dict[str, Any]]:
    held = {name: median(start.rss_mb[name] for start in starts) for name in starts[0].rss_mb}
    whole, before, lines = max(held.values()), 0.0, []
    for name, value in held.items():
        part = max(0.0, value - before)
        lines.append({"part": PARTS[name], "MB": round(part, 1), "share %": round(100 * part / whole, 1)})
        before = max(before, value)
    return lines


def _start_parts(starts: Sequence[ColdStart]) -> list[dict[str, Any]]:
    parts = {"start_ms": "Python", "import_ms": "numpy and runtime", "engine_ms": "engine library",
             "load_ms": "verify and load the graphs", "first_ms": "first inference"}  # fmt: skip
    return [
        {"part": part, "ms": round(median(getattr(start, name) for start in starts), 1)} for name, part in parts.items()
    ]


def _telemetry(telemetry: Summary) -> dict[str, list[dict[str, Any]]]:
    gauges = [
        {"reading": name, "unit": gauge.unit, "min": round(gauge.min, 4), "mean": round(gauge.mean, 4),
         "max": round(gauge.max, 4)}
        for name, gauge in telemetry.gauges.items()
    ]  # fmt: skip
    counters = [
        {"reading": name, "unit": counter.unit, "difference": round(counter.difference, 4)}
        for name, counter in telemetry.counters.items()
        if name not in OWN_COUNTERS
    ]
    unmeasured = _absent_table(telemetry.unmeasured)
    return {titles.TELEMETRY: [*gauges, *counters], **({titles.MISSING_VALUES: unmeasured} if unmeasured else {})}


def _absent_table(absent: Sequence[Absent]) -> list[dict[str, str]]:
    """Return what is unmeasured and why; sources of other kinds of boards in one line."""
    others = [part.reader for part in absent if part.other_board]
    lines = [{"what": part.reader, "why": part.reason} for part in absent if not part.other_board]
    if others:
        why = "this machine does not have them; vlatool telemetry says more"
        lines.append({"what": ", ".join(sorted(others)), "why": why})
    return lines
