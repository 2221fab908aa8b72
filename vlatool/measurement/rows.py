"""From what a measurement found to the rows of a report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np

from vlatool.measurement.cold_start import PARTS
from vlatool.measurement.interleaved import latency_measurements, percentile_measurements, speedup_of
from vlatool.measurement.paced import overloaded, paced_measurements
from vlatool.report import Measurement

ENERGY_S = 10.0
"""Seconds below which the energy of a run says little (MLPerf Tiny: runs of 10 s)."""
OWN = ("process.cpu", "process.involuntary_switches")
"""Counters that the measurements hold over exactly the timed part."""
OTHER_BOARDS = ("this is no ", "virtual machine or ", "NVIDIA card", "NVML tells nothing")
"""What the reason says where a source of telemetry belongs to another kind of board: told in one line."""
WINDOW = 0.1
"""Share of a sustained run that is its start, and its end."""


def samples_of(policy: Mapping[str, Any]) -> list[float]:
    """Return the milliseconds of all calls."""
    return [value for block in policy["blocks_ms"] for value in block]


def measurements(
    found: Mapping[str, Any], policy: Mapping[str, Any], reference: Mapping[str, Any] | None, rate: float
) -> list[Measurement]:
    """Return the numbers of one policy.

    Args:
        found: Of the whole run.
        policy: One of its policies.
        reference: What its speed is compared with; None when it ran alone.
        rate: Ticks in a second; 0 for calls back to back.
    """
    samples, paced = samples_of(policy), policy.get("paced")
    most = math.inf if not paced else 0.0 if overloaded(paced, len(samples)) else float(paced["worth"])
    seconds = len(samples) / rate if paced else None
    measured = latency_measurements(samples, refusals=reference is None, most=most, seconds=seconds)
    if reference is not None:
        return [*measured, speedup_of(policy["blocks_ms"], reference["blocks_ms"], reference["name"]), *cold(policy)]
    if paced:
        note = "from the moment at which the tick was due"
        measured = [replace(each, note=each.note or note) for each in measured]
        measured += paced_measurements(paced, len(samples), rate)
    else:
        measured.append(_throughput(samples))
    measured.append(_jitter(samples))
    busy = float(found["cpu_s"]) / max(float(found["wall_s"]), 1e-9)
    measured.append(Measurement("cpu", busy, "cores", note="user and system time of the process over the run"))
    inferences = int(paced["inferences"]) if paced else len(samples)
    return [*measured, *_board(found, inferences), *_golden(policy), *cold(policy)]


def _throughput(samples: Sequence[float]) -> Measurement:
    return Measurement("throughput", 1e3 / float(np.mean(samples)), "1/s", samples=len(samples), note="back to back")


def _jitter(samples: Sequence[float]) -> Measurement:
    value = float(np.subtract(*np.percentile(samples, [75, 25])))
    return Measurement("jitter", value, "ms", samples=len(samples), note="between the quartiles of the latency")


def _board(found: Mapping[str, Any], actions: int) -> list[Measurement]:
    """Return power, energy and the highest temperature, where the board tells them."""
    telemetry = found.get("telemetry") or {}
    measured = []
    for energy in telemetry.get("energy", ())[:1]:
        watts = float(energy["mean_w"])
        note = f"{energy['label']} ({energy['source']}), idle power included"
        measured.append(Measurement("power_mean", watts, "W", samples=energy["samples"], note=note))
        if energy["seconds"] >= ENERGY_S:
            seconds = float(found["ended_s"]) - float(found["begun_s"])
            measured.append(
                Measurement("energy_per_action", watts * seconds / actions, "J", samples=actions, note=note)
            )
        else:
            short = f"the run took {energy['seconds']:.1f} s; pass --duration {ENERGY_S:g} or more"
            measured.append(Measurement("energy_per_action", float("nan"), "J", note=short))
    hot = [(gauge["max"], name) for name, gauge in telemetry.get("gauges", {}).items() if gauge["unit"] == "degC"]
    if hot:
        value, name = max(hot)
        measured.append(Measurement("temperature_max", value, "degC", note=name))
    return measured


def _golden(policy: Mapping[str, Any]) -> list[Measurement]:
    error = policy.get("golden_error")
    note = "relative difference of the golden action from the recorded one"
    return [] if error is None else [Measurement("golden_error", float(error), "1", samples=1, note=note)]


def cold(policy: Mapping[str, Any]) -> list[Measurement]:
    """Return the cold start and the memory of fresh processes."""
    starts = policy.get("cold")
    if policy.get("cold_error"):
        return [Measurement("cold_start", math.nan, "ms", note=policy["cold_error"])]
    if not starts:
        return []
    count = len(starts)
    note = f"fresh process; median of {count}"
    peak = median(each["peak_rss_mb"] for each in starts)
    steady = median(list(each["rss_mb"].values())[-1] for each in starts)
    total = median(each["total_ms"] for each in starts)
    cached = f"start of the process to the first action, its files in the page cache; {note}"
    return [
        Measurement("peak_rss", peak, "MB", samples=count, note=f"import, load, inferences in a {note}"),
        Measurement("steady_rss", steady, "MB", samples=count, note=f"after some inferences in a {note}"),
        Measurement(
            "cold_start",
            total,
            "ms",
            samples=count,
            note=cached,
        ),
    ]


def sustained(samples: Sequence[float]) -> list[Measurement]:
    """Return the median at the start of a long run and at its end, each with its bound, and their ratio."""
    count = max(1, int(WINDOW * len(samples)))
    found = []
    for name, which, part in (("start", "first", samples[:count]), ("sustained", "last", samples[-count:])):
        (middle,) = percentile_measurements(f"latency_{name}", part, (50.0,))
        found.append(replace(middle, note=f"median of the {which} {100 * WINDOW:g} % of the run"))
    slowdown = found[1].value / found[0].value
    note = "end over start of the run"
    return [*found, Measurement("sustained_slowdown", slowdown, "x", samples=2 * count, note=note)]


def raw(found: Mapping[str, Any], policy: Mapping[str, Any], alone: bool) -> dict[str, list[float]]:
    """Return every sample: latencies, when each call began, and, of a run alone, what the board told meanwhile."""
    series = {"latency_ms": samples_of(policy), "at_s": list(policy["at_s"])}
    telemetry = found.get("telemetry")
    if not alone or not telemetry:
        return series
    begun = float(found["begun_s"])
    for name, gauge in telemetry["gauges"].items():
        series[f"telemetry.{name}"] = list(gauge["values"])
        series[f"telemetry.{name}.at_s"] = [round(when - begun, 3) for when in gauge["times"]]
    flags = [gauge for gauge in telemetry["gauges"].values() if gauge["unit"] == "throttle"]
    moments = sorted(
        round(when - begun, 3)
        for gauge in flags
        for when, value in zip(gauge["times"], gauge["values"], strict=True)
        if value
    )
    return {**series, **({"throttled_at_s": moments} if moments else {})}


def tables(found: Mapping[str, Any], policy: Mapping[str, Any], alone: bool) -> dict[str, list[dict[str, Any]]]:
    """Return what belongs to a policy as tables: engine, phases, memory and cold start by part, telemetry."""
    told: dict[str, list[dict[str, Any]]] = {}
    if policy.get("engines"):
        told["engine"] = policy["engines"]
    if policy.get("phases"):
        told["time by phase"] = policy["phases"]
    if policy.get("cold"):
        told |= {"memory by part": _memory_parts(policy["cold"]), "cold start by part": _start_parts(policy["cold"])}
    telemetry = found.get("telemetry")
    if alone and telemetry:
        told |= _telemetry(telemetry)
    return told


def _memory_parts(starts: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    held = {name: median(each["rss_mb"][name] for each in starts) for name in starts[0]["rss_mb"]}
    whole, before, lines = max(held.values()), 0.0, []
    for name, value in held.items():
        part = max(0.0, value - before)
        lines.append({"part": PARTS[name], "MB": round(part, 1), "share %": round(100 * part / whole, 1)})
        before = max(before, value)
    return lines


def _start_parts(starts: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    parts = {"start_ms": "Python", "import_ms": "numpy and runtime", "engine_ms": "engine library",
             "load_ms": "verify and load the graphs", "first_ms": "first inference"}  # fmt: skip
    return [{"part": told, "ms": round(median(each[name] for each in starts), 1)} for name, told in parts.items()]


def _telemetry(telemetry: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    gauges = [
        {"reading": name, "unit": each["unit"], "min": round(each["min"], 4), "mean": round(each["mean"], 4),
         "max": round(each["max"], 4)}
        for name, each in telemetry["gauges"].items()
    ]  # fmt: skip
    counters = [
        {"reading": name, "unit": each["unit"], "difference": round(each["difference"], 4)}
        for name, each in telemetry["counters"].items()
        if name not in OWN
    ]
    absent = _absent(telemetry["unmeasured"])
    return {"telemetry": [*gauges, *counters], **({"unmeasured": absent} if absent else {})}


def _absent(unmeasured: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """Return what is unmeasured and why; sources of other kinds of boards in one line."""
    others = [each["reader"] for each in unmeasured if any(sign in each["reason"] for sign in OTHER_BOARDS)]
    told = [{"what": each["reader"], "why": each["reason"]} for each in unmeasured if each["reader"] not in others]
    if others:
        why = "this machine does not have them; vlatool telemetry says more"
        told.append({"what": ", ".join(sorted(others)), "why": why})
    return told
