from __future__ import annotations

import math
import random

from vlatool.report import Measurement, Report, Row

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
                  HOSTILE, HOSTILE, {HOSTILE: {"a": HOSTILE}}, (HOSTILE,))  # fmt: skip


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
    "evaluate": evaluate,
    "compare": compare,
    "hostile": hostile,
    "hwselect": hwselect,
    "hostile-boards": hostile_boards,
    "no-boards": lambda: Report("hwselect", "Boards for nothing", "fail"),
    "empty": lambda: EMPTY,
    "bare": lambda: Report("compare", "", rows=(Row(""), Row("b", "failed"))),
}
