"""Rows and sentences of the report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from vlatool.explain._candidates import Candidate, Comparison
from vlatool.explain._float_roundtrips import Fallback, RoundTrip
from vlatool.explain._operators import GROUPS, Operator, shares
from vlatool.explain._origin import command
from vlatool.machine.host import isa
from vlatool.machine.instruction_sets import saturates
from vlatool.measurement.interleaved import latency_measurements, speedup
from vlatool.measurement.reach import LIKELY_SHARE, share_of_reach
from vlatool.measures import series
from vlatool.measures.actions import RAW_RELATIVE_ERROR
from vlatool.report import Row
from vlatool.sensitivity.layers import LayerError

MAX_ROWS = 10
MAX_ELEMENTS = 12
"""Largest number of elements in a table: of a longer action, those that the worst layer changes most."""
MAX_OTHERS = 6
"""Largest number of operator types in a sentence, besides products."""
INT8_SPEEDUP = 4.0
"""Float32 instructions that one int8 instruction of the same width replaces."""
INT8_SPEEDUP_IN_PAIRS = 2.0
"""The same without VNNI: three instructions replace six of float32."""


def layers_table(layers: Sequence[LayerError], several: bool) -> list[dict[str, Any]]:
    """Return the ten worst layers: error, largest error of an element, flips, jump, share of the MACs."""
    rows = []
    names = short_names(layers)
    for layer in layers[:MAX_ROWS]:
        name = names[layer.name]
        row: dict[str, Any] = {"layer": f"{layer.graph}: {name}" if several else name}
        row |= {"error %": round(100 * layer.error, 3), "flips %": round(100 * layer.flips, 1)}
        row |= {"jump %": round(100 * layer.jump, 1), "MACs %": round(100 * layer.macs_share, 2)}
        rows.append(row)
    return rows


def short_names(layers: Sequence[LayerError]) -> dict[str, str]:
    """Return node name -> name of its module (``a.b`` of ``a.b/MatMul``) where no other layer has the same one."""
    modules = Counter(layer.name.rpartition("/")[0] for layer in layers)
    names = {}
    for layer in layers:
        module = layer.name.rpartition("/")[0]
        names[layer.name] = module if module and modules[module] == 1 else layer.name
    return names


def elements_table(layers: Sequence[LayerError], units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the effect of the three worst layers on each element of the action, in its unit."""
    worst = [layer for layer in layers[:3] if layer.elements]
    names = short_names(layers)
    rows: list[dict[str, Any]] = []
    labels = list(worst[0].elements) if worst else []
    largest = sorted(labels, key=lambda label: -worst[0].elements[label])[:MAX_ELEMENTS]
    for label in (label for label in labels if label in largest):
        unit = units.get(label, "")
        shown, factor = ("mm", 1000.0) if unit == "m" else (unit, 1.0)
        numbers = {names[layer.name]: float(f"{layer.elements[label] * factor:.3g}") for layer in worst}
        rows.append({"element": label, "unit": shown, **numbers})
    return rows


def layers_sentence(layers: Sequence[LayerError]) -> str:
    """Return the sentence about the layers that cost the accuracy."""
    worst = layers[0]
    squares = sum(layer.error**2 for layer in layers) or 1.0
    text = f"The layer that costs most is '{short_names(layers)[worst.name]}': alone in int8 it moves the action by"
    text += f" {worst.error:.2%}"
    text += f" ({worst.macs_share:.1%} of its graph's MACs)" if not math.isnan(worst.macs_share) else ""
    if len(layers) > 2:
        middle = sorted(layer.error for layer in layers)[len(layers) // 2]
        text += f"; the middle one of {len(layers)} by {middle:.2%}"
    share = worst.error**2 / squares
    return f"{text}. It makes {share:.0%} of the sum of squared errors of all layers (on {worst.samples} observations)."


def time_sentence(operators: Sequence[Operator]) -> str:
    """Return the sentence about where the time goes."""
    total = sum(operator.ms for operator in operators)
    parts = [f"{share:.0%} {name}" for name, share in shares(operators).items() if share >= 0.005]
    return f"Of {total:.3g} ms inside operators: {', '.join(parts)}."


def round_trips_table(trips: Sequence[RoundTrip]) -> list[dict[str, Any]]:
    """Return the ten most expensive round trips."""
    return [
        {
            "from": trip.start.removesuffix("/dequantize"),
            "in float": " ".join(trip.between) or "nothing",
            "to": trip.end.removesuffix("/quantize"),
            "ms": round(trip.ms, 4),
        }
        for trip in trips[:MAX_ROWS]
    ]


def round_trips_sentence(trips: Sequence[RoundTrip], pairs: tuple[int, int], operators: Sequence[Operator]) -> str:
    """Return the sentence about round trips through float."""
    total = sum(part.ms for part in operators) or 1.0
    text = f"The file quantizes {pairs[0]} values and dequantizes {pairs[1]} at run time"
    if not trips:
        return f"{text}; no value goes from int8 to float and back without a layer in between."
    spent = sum(part.ms for part in trips)
    direct = sum(not part.between for part in trips)
    text += f"; {len(trips)} of them go int8 -> float -> int8 with only light operators in between"
    text += f" ({direct} with none)" if direct else ""
    if not spent:
        return f"{text}. The profile shows none of them: the engine fused them, so they cost nothing."
    return f"{text}. They take {spent:.3g} ms, {spent / total:.1%} of the time."


def fallbacks_table(fallbacks: Sequence[Fallback]) -> list[dict[str, Any]]:
    """Return the ten most expensive layers that fell back."""
    return [
        {"layer": fallback.layer, "what happened": fallback.why, "ms": round(fallback.ms, 4)}
        for fallback in fallbacks[:MAX_ROWS]
    ]


def fallbacks_sentence(fallbacks: Sequence[Fallback], operators: Sequence[Operator]) -> str:
    """Return the sentence about layers that did not run as fast int8 kernels."""
    total = sum(part.ms for part in operators) or 1.0
    if not fallbacks:
        return "Every layer that is int8 in the file runs as an int8 kernel."
    whys: dict[str, list[Fallback]] = {}
    for part in fallbacks:
        whys.setdefault(part.why, []).append(part)
    parts = []
    for why, members in whys.items():
        spent = sum(part.ms for part in members)
        parts.append(f"{len(members)} layers: {why} ({spent:.3g} ms, {spent / total:.0%} of the time)")
    return "Fell back: " + "; ".join(parts) + "."


def limit_sentences(
    operators: Sequence[Operator], before: Sequence[Operator], macs: Mapping[str, int], speed: float
) -> list[str]:
    """Return why int8 is not faster: Amdahl's law on the measured time of both bundles.

    Args:
        before: Operators of the float32 bundle; empty when it was not found.
        macs: Precision -> multiply-accumulates of one inference of the bundle.
        speed: Measured speed-up over float32; that of the profiles when NaN.
    """
    sentences = []
    products = sum(operator.ms for operator in operators if operator.product)
    total = sum(operator.ms for operator in operators) or 1.0
    all_macs = sum(macs.values()) or 1
    kinds = ", ".join(f"{count / all_macs:.0%} {kind}" for kind, count in macs.items() if count)
    text = f"By count the MACs are {kinds}; matrix products and convolutions take {products / total:.0%} of the time"
    text += f", at {all_macs / products / 1e6:.3g} GMAC/s" if products and macs else ""
    heavy = sum(operator.ms for operator in before if operator.product)
    text += f" (float32: {all_macs / heavy / 1e6:.3g})" if heavy and products and macs else ""
    sentences.append(f"{text}.")
    if before:
        base = sum(operator.ms for operator in before) or 1.0
        actual = base / total if math.isnan(speed) else speed
        rest = base - heavy
        faster, word = (INT8_SPEEDUP_IN_PAIRS, "two") if saturates(isa() or ()) else (INT8_SPEEDUP, "four")
        ideal, limit = base / (rest + heavy / faster), base / rest if rest else math.inf
        text = f"In float32 they took {heavy / base:.0%} of {base:.3g} ms. By Amdahl's law products {word} times as"
        text += f" fast make the whole {ideal:.2g}x as fast, and products for nothing {limit:.2g}x;"
        text += f" measured: {actual:.2g}x."
        overhead = total - products - rest
        if overhead > 0.02 * total:
            text += f" What is not a product takes {overhead:.2g} ms more than in float32: quantizing and moving data."
        sentences.append(text)
    return sentences


def reach_sentence(operators: Sequence[Operator], macs: Mapping[str, int], reach: Mapping[str, float]) -> list[str]:
    """Return the share of the time that the work would take at the speed of large products, and the rest.

    Args:
        macs: Precision -> multiply-accumulates of one inference.
        reach: Precision -> 10^9 multiply-accumulates in a second of a large product in the same engine.
    """
    total = sum(operator.ms for operator in operators)
    share = share_of_reach(macs, reach, total / 1e3)
    if share is None:
        return []
    products = sum(operator.ms for operator in operators if operator.product)
    speeds = ", ".join(f"{name} {speed:.3g} GMAC/s" for name, speed in reach.items() if macs.get(name))
    text = (
        f"At the speed of a large product here ({speeds}) its MACs would take {share * total:.3g} of the {total:.3g} ms"
    )
    text += f" ({share:.0%})."
    if share > LIKELY_SHARE:
        text += " More than all of it: other work slowed the large product down, or the engine leaves work out."
    others: Counter[str] = Counter()
    for operator in operators:
        others[operator.kind] += 0 if operator.product else operator.ms  # type: ignore[assignment]
    listed = ", ".join(f"{kind} {ms:.2g} ms" for kind, ms in others.most_common(MAX_OTHERS) if ms > 0.005 * total)
    slower = f"its products take {products - share * total:.2g} ms more than that" if products > share * total else ""
    rest = f"everything else {total - products:.2g} ms{f': {listed}' if listed else ''}"
    text += f" The rest: {', '.join(filter(None, (slower, rest)))}."
    return [text]


def precision_table(operators: Sequence[Operator]) -> list[dict[str, Any]]:
    """Return ms and share of the time by effective precision."""
    total = sum(operator.ms for operator in operators) or 1.0
    time_shares = shares(operators)
    order = [*GROUPS, *(name for name in time_shares if name not in GROUPS)]
    return [
        {"computed as": name, "ms": round(time_shares[name] * total, 4), "share %": round(100 * time_shares[name], 1)}
        for name in order
        if name in time_shares
    ]


def candidate_row(candidate: Candidate, comparison: Comparison, where: Mapping[str, Any], source: str) -> Row:
    """Return the row of a candidate, of the current bundle, or of the float32 bundle."""
    measurements = []
    samples: list[float] = []
    reference = comparison.baseline or comparison.current
    if candidate.contestant is not None and reference.contestant is not None:
        samples = candidate.contestant.samples
        measurements = latency_measurements(samples)
        if candidate is not reference:
            measurements.append(speedup(candidate.contestant, reference.contestant))
    if not math.isnan(candidate.error) and candidate is not comparison.baseline:
        note = "mean over observations of |difference|2 / |raw action|2, to float32"
        count = len(candidate.contestant.observations) if candidate.contestant else 0
        measurements.append(RAW_RELATIVE_ERROR.measurement(candidate.error, samples=count, note=note))
    role, reason = "subject", ""
    if candidate is comparison.baseline:
        role = "baseline"
    elif candidate is comparison.suggestion:
        role = "chosen"
    if candidate.stage is not None:
        reason = command(candidate.stage, source)
    return Row(candidate.name, role, reason, tuple(measurements), {series.LATENCY: samples} if samples else {}, where)


def suggestion(comparison: Comparison, source: str) -> list[str]:
    """Return the sentence with the suggested command; none when nothing helps enough."""
    best = comparison.suggestion
    if best is None or best.stage is None:
        return []
    return [f"Do this: {command(best.stage, source)} ({_effect(best, comparison.current)})."]


def trial_sentences(comparison: Comparison, worst: Sequence[LayerError]) -> list[str]:
    """Return a sentence for each candidate, with its measurements."""
    sentences = []
    for candidate in comparison.others:
        names = ", ".join(f"'{short_names(worst)[layer.name]}'" for layer in worst[: candidate.layers])
        what = candidate.name.partition("without")[0] + (f"exclude {names}" if candidate.layers else "")
        sentences.append(f"Tried: {what}: {_effect(candidate, comparison.current)}.")
    if comparison.others and comparison.suggestion is None:
        sentences.append("None of these helps enough to be suggested: the error is spread over many layers.")
    return sentences


def _effect(candidate: Candidate, current: Candidate) -> str:
    """Return error and latency of a candidate relative to the current bundle, the latency with its 95 % interval."""
    error = f"error {current.error:.2%} -> {candidate.error:.2%}"
    if candidate.contestant is None or current.contestant is None:
        return error
    ratio = speedup(current.contestant, candidate.contestant)  # its latency in units of the other's
    change = f"latency {ratio.value - 1:+.0%}"
    if ratio.low is None or ratio.high is None:
        return f"{error}, {change}"
    return f"{error}, {change} ({ratio.low - 1:+.0%} to {ratio.high - 1:+.0%})"
