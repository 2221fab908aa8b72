"""The answer of ``hwselect`` as a report: a row for each board, with the reason in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from vlatool.boards.select import Choice, Wants, cost
from vlatool.bundle.bundle import MANIFEST
from vlatool.graph.workload import Workload
from vlatool.latency_model.predict import numbers
from vlatool.measures import resources, tables
from vlatool.report import Report, Row

ROLES = {"fits": "within", "may fit": "subject", "unknown": "subject", "no": "outside"}


def boards_report(
    name: str, load: Workload, choices: Sequence[Choice], wants: Wants, cloud: Choice | None, command: str = ""
) -> Report:
    """Return the report, the best board first."""
    first = next((choice for choice in choices if choice.state == "fits"), None)
    rows = tuple(_row(choice, wants, cloud, chosen=choice is first) for choice in choices)
    return Report(
        "hwselect",
        f"Boards for {name}",
        "pass" if first else "fail" if all(choice.state == "no" for choice in choices) else "inconclusive",
        summary=(*_summary(name, choices, first, wants), work_sentence(load), *chunk_sentence(first, wants)),
        rows=rows,
        limits=limits(wants),
        command=command,
        created=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        warnings=_warnings(first),
    )


def work_sentence(load: Workload) -> str:
    """Say what one inference computes, graph by graph."""
    parts = []
    for name, runs in load.runs.items():
        graph = load.graphs[name]
        weights, macs = graph.weights, sum(graph.macs.values())
        times = f", run {runs} times" if runs > 1 else ""
        parts.append(f"{name} {_si(macs)} multiply-accumulates with {_si(weights)} weights{times}")
    return f"One inference: {'; '.join(parts)}."


def chunk_sentence(first: Choice | None, wants: Wants) -> list[str]:
    """Say what a chunk of actions costs on the chosen board, and each action of it."""
    if wants.execute < 2 or first is None or first.outcome is None:
        return []
    ms, joules, count = first.outcome.latency.ms, first.outcome.joules, wants.execute
    sentence = (
        f"One inference gives a chunk, of which {count} actions are executed: with one inference for each chunk, a "
        f"control tick costs {_number(ms / count)} ms and {_number(joules / count)} J there."
    )
    if wants.per_chunk or not wants.hz:
        return [sentence]
    return [f"{sentence} This answer is for an inference at every tick; for one in each chunk: --per-chunk."]


def limits(wants: Wants) -> dict[str, Any]:
    """Return what was asked for: name with its unit -> value."""
    asked = {
        "hz": wants.hz, "ticks_an_inference": wants.execute if wants.per_chunk else None,
        "latency_ms": wants.latency_ms, "max_watts": wants.watts, "max_price_usd": wants.price,
        "memory_gb": wants.memory_gb, "precision": ", ".join(wants.precisions) or None,
    }  # fmt: skip
    return {name: value for name, value in asked.items() if value is not None}


def _summary(name: str, choices: Sequence[Choice], first: Choice | None, wants: Wants) -> list[str]:
    count = sum(choice.state == "fits" for choice in choices)
    if first is None or first.outcome is None:
        near = [choice for choice in choices if choice.state == "may fit"]
        verdict = f"No board is certain to run {name} within these limits"
        if near:
            return [f"{verdict}; {len(near)} may: {', '.join(choice.profile.name for choice in near[:4])}."]
        return [f"{verdict}. The reasons stand beside the boards."]
    outcome, way = first.outcome, first.outcome.candidate
    fit = f"{count} boards that fit" if count > 1 else "1 board that fits"
    text = (
        f"{first.profile.name} is the cheapest of {fit}: {way.precision or 'as it is'} "
        f"with {way.engine} at {way.mode}, about {_number(outcome.latency.ms)} ms "
        f"({_number(outcome.latency.low)}-{_number(outcome.latency.high)}), {outcome.watts[0]:.0f} W, "
        f"{first.profile.price_usd.value:,.0f} dollars."
    )
    hz = f" --hz {wants.inference_hz:g}" if wants.inference_hz else ""
    if not way.precision:  # a bundle that is quantized already
        return [text]
    if (Path(name) / MANIFEST).is_file():
        quantize = f"Next: vlatool quantize static-int8 {name} -o out/int8"
        return [text, quantize] if way.precision == "int8" else [text]
    out = f"out/{Path(name).stem}"
    return [text, f"Next: vlatool optimize {name} --profile {first.profile.name}{hz} --max-drop 1% -o {out}"]


def _warnings(first: Choice | None) -> tuple[str, ...]:
    warnings = ["everything here is predicted; measure before you buy many: vlatool benchmark on one board, then "
            "vlatool profiles calibrate --from its report"]  # fmt: skip
    if first is not None:
        warnings += list(first.profile.caveats[:2])
    return tuple(warnings)


def _row(choice: Choice, wants: Wants, cloud: Choice | None, *, chosen: bool) -> Row:
    outcome = choice.outcome
    way: dict[str, Any] = {"state": choice.state}
    board = choice.profile.name
    measurements = [resources.PRICE.prediction(choice.profile.price_usd.value, board)]
    if outcome is not None:
        candidate = outcome.candidate
        way |= {"power mode": candidate.mode, "engine": candidate.engine, "precision": candidate.precision}
        measurements += numbers(outcome, wants.execute)
        spent = cost(choice, wants, cloud)
        for quantity, value in (
            (resources.AVERAGE_WATTS, spent.average_watts), (resources.OWNED_COST, spent.owned),
            (resources.CLOUD_COST, spent.cloud), (resources.BREAK_EVEN, spent.break_even_hours),
            (resources.BATTERY_LIFE, spent.battery_hours),
        ):  # fmt: skip
            if not math.isnan(value):
                measurements.append(quantity.prediction(value, board))
    role = "chosen" if chosen else ROLES[choice.state]
    return Row(board, role, choice.reason, tuple(measurements), details={tables.WAY: [way]})


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _si(value: float) -> str:
    for factor, letter in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g} {letter}"
    return f"{value:.0f}"
