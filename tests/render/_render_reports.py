from __future__ import annotations

import math
import random

from vlatool.report import Finding, Measurement, Report, Row

HOSTILE = "<script>alert('x')</script> | `a` \x1b[31m \"&\" \n[b](c) \u202e"


def latencies(seed: int, median: float, count: int) -> list[float]:
    draw = random.Random(seed)
    return [median * math.exp(draw.gauss(0, 0.05)) * (3 if draw.random() < 0.005 else 1) for _ in range(count)]


def variant(name: str, role: str, seed: int, median: float, success: float, samples: int = 200) -> Row:
    raw = latencies(seed, median, samples)
    p50 = sorted(raw)[len(raw) // 2]
    measurements = [
        Measurement("latency_p50", p50, "ms", samples=samples, low=p50 * 0.98, high=p50 * 1.03),
        Measurement("latency_p99", p50 * 1.2, "ms", samples=samples, low=p50 * 1.1, high=p50 * 1.4, confidence=0.9),
        Measurement("success", success, "1", samples=1000, low=success - 0.01, high=success + 0.006, note="played"),
        Measurement("size", 11.0, "MB"),
        Measurement("peak_rss", 412.3, "MB", samples=1),
        Measurement("dream_depth", 12345.6, "fathom", note="no renderer knows this name"),
        Measurement("latency_p50", median * 3, "ms", "predicted", "raspberry-pi-5", low=median * 2, high=median * 5,
                    note="roofline"),
        Measurement("energy", 0.5, "J", "predicted", "jetson-orin-nano"),
    ]  # fmt: skip
    if role != "baseline":
        measurements += [
            Measurement("speedup", 41.3 / p50, "x", samples=samples, low=1.0, high=4.0),
            Measurement("success_drop", 0.984 - success, "1", samples=1000, low=-0.005, high=0.03, note="paired"),
            Measurement("mcnemar_p", 0.04, "1", samples=1000),
            Measurement("error_baseline", 0.012, "1", samples=50),
            Measurement("error_baseline.dx", 0.00035, "m", samples=50, note="mean |error|"),
            Measurement("error_baseline.gripper", 0.2, "1", samples=50, note="mean |error|"),
            Measurement("gripper_flips_baseline", 0.0007, "1", samples=8000, low=0.0, high=0.002),
        ]
    table = [
        {"task": task, "success": 0.9, "low": 0.8, "high": 0.95, "episodes": 200, "hard": task == "push"}
        for task in ("reach", "push")
    ]
    return Row(name, role, f"{name} is {role}", tuple(measurements), {"latency_ms": raw}, {"success by task": table})


def optimize(samples: int = 200) -> Report:
    rows = (
        variant("float32", "baseline", 1, 41.3, 0.984, samples),
        variant("static_int8", "chosen", 2, 11.8, 0.981, samples),
        variant("dynamic_int8", "within", 3, 17.6, 0.984, samples),
        variant("pruned_50_static_int8", "outside", 4, 8.2, 0.92, samples),
        Row("float16", "failed", "no kernel", (Measurement("latency_p50", math.nan, "ms", note="engine refused"),)),
        variant("mixed_int8", "outside", 5, 22.4, 0.97, samples),
    )
    return Report(
        "optimize",
        "vla for raspberry-pi-5",
        "pass",
        ("static_int8 is 3.5 times as fast.", "It loses 0.3 points."),
        rows,
        {"latency_p50_ms": 25, "max_success_drop_points": 2, "strict": True},
        "vlatool optimize policy.py:make --profile raspberry-pi-5",
        "2026-11-21T12:00:00Z",
        {"cpu": "AMD EPYC", "versions": {"numpy": "2.4.6"}, "cores": 2, "battery": None, "ids": [1, 2.5]},
        ("The clock was not locked. Lock it with cpupower.",),
    )


def benchmark() -> Report:
    row = Row("float32", measurements=(Measurement("latency_p50", 0.0412, "ms", samples=30),),
              raw={"latency_ms": latencies(1, 0.04, 30)})  # fmt: skip
    return Report("benchmark", "Latency of vln", rows=(row,), environment={"cpu": {"model": "Cortex-A76"}})


def evaluate() -> Report:
    def row(name: str, role: str, share: float, where: str) -> Row:
        items = (
            Measurement("agreement_expert", share, "1", where=where, samples=480, low=share - 0.02, high=share + 0.01),
            Measurement("error_expert", 0.3, "1", where=where),
        )
        return Row(name, role, "", items, details={"paired": [{"lost": 3, "won": 2, "p": 0.5}]} if share < 0.9 else {})

    rows = (row("float32", "baseline", 0.91, "this host"), row("int8", "subject", 0.89, "pi.local"))
    return Report("evaluate", "vln on 480 observations", "inconclusive", ("The samples cannot decide.",), rows)


def compare(count: int = 9) -> Report:
    rows = tuple(
        variant(f"candidate-with-a-rather-long-name-{i}", "subject", i, 5.0 + i, 0.9 + i / 100) for i in range(count)
    )
    return Report("compare", "Nine candidates", "fail", rows=rows, limits={"latency_p99_ms": 7, "min_success": 0.95})


def hostile() -> Report:
    items = (
        Measurement("latency_p50", 5.0, "ms", where=HOSTILE, low=4.0, high=6.0, note=HOSTILE, samples=3),
        Measurement(HOSTILE, 1e-7, HOSTILE, note=HOSTILE),
        Measurement(f"error.{HOSTILE}", 0.1, "m"),
        Measurement(HOSTILE, math.nan, "ms", "predicted", HOSTILE, note=HOSTILE),
        Measurement("success", math.inf, "1"),
        Measurement("success_drop", -1.0, "1"),
    )
    rows = tuple(
        Row(f"{index}{HOSTILE}{'長' * 60}", role, HOSTILE, items, {"latency_ms": [1.0, 2.0, math.nan, 1e9]},
            {HOSTILE: [{HOSTILE: HOSTILE, "n": 1, "x" * 200: {"nested": HOSTILE}}]})
        for index, role in enumerate(("baseline", "chosen"))
    )  # fmt: skip
    return Report("optimize", HOSTILE, "pass", (HOSTILE, "x" * 300), rows, {HOSTILE: HOSTILE, "latency_ms": 5.5},
                  HOSTILE, HOSTILE, {HOSTILE: {"a": HOSTILE}}, (HOSTILE,), validity="invalid",
                  findings=(Finding("invalid", HOSTILE, HOSTILE), Finding("note", HOSTILE)))  # fmt: skip


NEEDS = "needs 6,636 independent calls, this run is worth 1,204; pass --iterations 33000"
PARTS = {
    "memory by part": [{"part": "weights", "MB": 88.25, "share %": 40.0},
                       {"part": "the rest", "MB": 132.4, "share %": 60.0}],
    "time by phase": [{"phase": "encode", "calls": 9, "p50 ms": 1.0, "share %": 5.0},
                      {"phase": "graph", "calls": 9, "p50 ms": 19.0, "share %": 95.0}],
    "cold start by part": [{"part": "import", "ms": 300.0}, {"part": "load", "ms": 500.0}],
    "telemetry": [{"reading": "thermal.cpu-thermal", "unit": "degC", "min": 45.0, "mean": 66.2, "max": 78.5}],
    "unmeasured": [{"what": "GPU memory", "why": "no GPU"}, {"what": "GPU clock", "why": "no GPU"}],
    "engine": [{"engine": "ort_cpu", "version": "1.23.2", "threads": 1}],
}  # fmt: skip


def profile(name: str, role: str, median: float, samples: int = 300, readings: int = 60) -> Row:
    """A row as the benchmark makes it: percentiles with bounds, a time line, tables by part and phase."""
    raw = latencies(int(median), median, samples)
    ordered, seconds = sorted(raw), samples * median / 500
    at = [index * seconds / samples for index in range(samples)]
    sampled = [index * seconds / readings for index in range(readings)]
    tops = [("latency_p50", 0.5), ("latency_p90", 0.9), ("latency_p95", 0.95), ("latency_p99", 0.99)]
    percentiles = [(which, ordered[math.ceil(share * samples) - 1]) for which, share in tops]
    items = [
        *(Measurement(which, found, "ms", samples=samples, high=found + 1, confidence=0.99)
          for which, found in percentiles),
        Measurement("latency_p99.9", math.nan, "ms", samples=samples, confidence=0.99, note=NEEDS),
        Measurement("latency_max", ordered[-1], "ms", samples=samples),
        Measurement("energy_per_action", math.nan, "J", note="no power meter"),
        Measurement("power_mean", math.nan, "W", note="no power meter"),
        Measurement("throughput", 1e3 / median, "1/s", samples=samples),
        Measurement("cpu", 1.93, "cores"),
        Measurement("peak_rss", 10 * median, "MB", samples=3),
        Measurement("temperature_max", 78.5, "degC"),
        Measurement("deadline_misses", 0.0123, "1", samples=2400, low=0.008, high=0.017, note="at 20 Hz"),
        Measurement("age_p99", 71.0, "ms", samples=2400),
        Measurement("sustained_slowdown", 1.24, "x", low=1.2, high=1.27),
    ]  # fmt: skip
    gauges = {"thermal.cpu-thermal": 45.0, "cpufreq.policy0": 2400.0, "ina3221.VDD_IN": 4.2}
    series = {"latency_ms": raw, "at_s": at, "throttled_at_s": [seconds * 0.6, seconds * 0.61]}
    for place, (gauge, level) in enumerate(gauges.items()):
        series[f"telemetry.{gauge}"] = [level * (1 + 0.01 * math.sin(second + place)) for second in sampled]
        series[f"telemetry.{gauge}.at_s"] = sampled
    return Row(name, role, "", tuple(items), series, PARTS)


THROTTLED = Finding("suspect", "The processor was throttled at 2 moments", "cool the board")


def sustained(rows: int = 2, samples: int = 300, readings: int = 60) -> Report:
    """A report of the benchmark, with a time line."""
    names = (("float32", "baseline" if rows > 1 else "subject", 41.0), ("static_int8", "subject", 12.0))
    return Report(
        "benchmark",
        "Latency of vla",
        summary=("float32: 41.0 ms.",),
        rows=tuple(profile(*name, samples, readings) for name in names[:rows]),
        limits={"deadline_ms": 50},
        environment={"cpu": "Cortex-A76", "governor": "ondemand"},
        validity="suspect",
        findings=(Finding("note", "Its clock is not known."), THROTTLED),
    )


def board(
    name: str, state: str, ms: float, price: float, reason: str = "", *, chosen: bool = False, cost: bool = True
) -> Row:
    """A row as ``hwselect`` makes it."""
    role = "chosen" if chosen else {"fits": "within", "no": "outside"}.get(state, "subject")
    way = {"state": state, "power mode": "15W", "engine": "ort_cpu", "precision": "int8"}
    known = not math.isnan(ms)
    ends = (ms / 2, ms * 2) if known else (None, None)
    items = [
        Measurement("price", price, "USD", "predicted", name),
        Measurement("latency_p50", ms, "ms", "predicted", name, 0, *ends, 0.8, "unseen: from other devices"),
        Measurement("memory", 512.0, "MB", "predicted", name, 0, 300.0, 900.0, 0.8, "a judgement"),
        Measurement("usable_memory", 7000.0, "MB", "predicted", name),
        Measurement("watts", 9.75, "W", "predicted", name, 0, 6.75, 14.25, 0.8),
    ]
    if cost and known:
        items += [
            Measurement(which, value, unit, "predicted", name)
            for which, value, unit in (
                ("energy", 0.2, "J"),
                ("average_watts", 5.5, "W"),
                ("owned_cost", 12345.0, "USD"),
            )
        ]
    return Row(name, role, reason or f"{name} is {state}", tuple(items), details={"way": [way]})


def hwselect() -> Report:
    rows = (
        board("raspberry-pi-5", "fits", 20.0, 80, chosen=True),
        board("jetson-orin-nano", "fits", 4.0, 399),
        board("jetson-nano", "may fit", 90.0, 99),
        board("raspberry-pi-5-hailo8", "unknown", math.nan, 190, "a transformer's latency there is unknown"),
        board("raspberry-pi-4", "no", 160.0, 55, "about 160 ms > 100 ms even at int8"),
        Row("jetson-agx-thor", "outside", "costs 3,499 dollars, more than 500",
            (Measurement("price", 3499, "USD", "predicted"),), details={"way": [{"state": "no"}]}),
    )  # fmt: skip
    told = "raspberry-pi-5 is the cheapest of 2 boards that fit."
    return Report("hwselect", "Boards for tiny", "pass", (told,), rows,
                  {"hz": 10.0, "max_price_usd": 500.0}, "vlatool hwselect tiny", "2026-11-21T12:00:00Z",
                  warnings=("everything here is predicted; measure before you buy many",))  # fmt: skip


def hostile_boards() -> Report:
    rows = tuple(board(f"{n}{HOSTILE}", state, 10.0 + n, 50 + n, HOSTILE, chosen=n == 0)
                 for n, state in enumerate(("fits", "may fit", "unknown", "no")))  # fmt: skip
    return Report("hwselect", HOSTILE, "pass", (HOSTILE,), rows, {HOSTILE: HOSTILE, "hz": 5.0}, HOSTILE, HOSTILE,
                  {}, (HOSTILE,))  # fmt: skip


EMPTY = Report("benchmark", "Nothing")
KINDS = {
    "optimize": optimize,
    "benchmark": benchmark,
    "sustained": sustained,
    "sustained-alone": lambda: sustained(1),
    "one-call": lambda: sustained(1, 1, 1),
    "evaluate": evaluate,
    "compare": compare,
    "hostile": hostile,
    "hwselect": hwselect,
    "hostile-boards": hostile_boards,
    "no-boards": lambda: Report("hwselect", "Boards for nothing", "fail"),
    "empty": lambda: EMPTY,
    "bare": lambda: Report("compare", "", rows=(Row(""), Row("b", "failed"))),
}
