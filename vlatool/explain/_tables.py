"""Rows of a report and sentences, made of what was found."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from vlatool.explain._islands import Fallback, Island
from vlatool.explain._operators import GROUPS, Operator, shares
from vlatool.explain._origin import command
from vlatool.explain._remedy import Candidate, Contest
from vlatool.measurement.interleaved import latency_measurements, speedup
from vlatool.report import Measurement, Row
from vlatool.sensitivity.layers import LayerError

MOST = 10
MOST_ELEMENTS = 12
"""Of a longer action those are shown that the worst layer moves most."""
FASTER = 4.0
"""What int8 does with one instruction of the same width that float32 does with four."""


def layers_table(found: Sequence[LayerError], several: bool) -> list[dict[str, Any]]:
    """Return the ten worst layers: error, largest error of an element, flips, jump, share of the MACs."""
    rows = []
    names = short_names(found)
    for each in found[:MOST]:
        name = names[each.name]
        row: dict[str, Any] = {"layer": f"{each.graph}: {name}" if several else name}
        row |= {"error %": round(100 * each.error, 3), "flips %": round(100 * each.flips, 1)}
        row |= {"jump %": round(100 * each.jump, 1), "MACs %": round(100 * each.macs_share, 2)}
        rows.append(row)
    return rows


def short_names(found: Sequence[LayerError]) -> dict[str, str]:
    """Return node name -> name of its module (``a.b`` of ``a.b/MatMul``) where no other layer has the same one."""
    modules = Counter(each.name.rpartition("/")[0] for each in found)
    made = {}
    for each in found:
        module = each.name.rpartition("/")[0]
        made[each.name] = module if module and modules[module] == 1 else each.name
    return made


def elements_table(found: Sequence[LayerError], units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return what the three worst layers do to each element of the action, in its unit."""
    worst = [each for each in found[:3] if each.elements]
    names = short_names(found)
    rows: list[dict[str, Any]] = []
    labels = list(worst[0].elements) if worst else []
    largest = sorted(labels, key=lambda label: -worst[0].elements[label])[:MOST_ELEMENTS]
    for label in (label for label in labels if label in largest):
        unit = units.get(label, "")
        shown, factor = ("mm", 1000.0) if unit == "m" else (unit, 1.0)
        numbers = {names[each.name]: float(f"{each.elements[label] * factor:.3g}") for each in worst}
        rows.append({"element": label, "unit": shown, **numbers})
    return rows


def layers_told(found: Sequence[LayerError]) -> str:
    """Return the sentence about the layers that cost the accuracy."""
    worst = found[0]
    squares = sum(each.error**2 for each in found) or 1.0
    text = f"The layer that costs most is '{short_names(found)[worst.name]}': alone in int8 it moves the action by"
    text += f" {worst.error:.2%}"
    text += f" ({worst.macs_share:.1%} of its graph's MACs)" if not math.isnan(worst.macs_share) else ""
    if len(found) > 2:
        middle = sorted(each.error for each in found)[len(found) // 2]
        text += f"; the middle one of {len(found)} by {middle:.2%}"
    share = worst.error**2 / squares
    return f"{text}. It makes {share:.0%} of the sum of squared errors of all layers (on {worst.samples} observations)."


def time_told(operators: Sequence[Operator]) -> str:
    """Return the sentence about where the time goes."""
    total = sum(each.ms for each in operators)
    parts = [f"{share:.0%} {name}" for name, share in shares(operators).items() if share >= 0.005]
    return f"Of {total:.3g} ms inside operators: {', '.join(parts)}."


def islands_table(found: Sequence[Island]) -> list[dict[str, Any]]:
    """Return the ten dearest round trips."""
    return [
        {
            "from": each.start.removesuffix("/dequantize"),
            "in float": " ".join(each.between) or "nothing",
            "to": each.end.removesuffix("/quantize"),
            "ms": round(each.ms, 4),
        }
        for each in found[:MOST]
    ]


def islands_told(found: Sequence[Island], pairs: tuple[int, int], operators: Sequence[Operator]) -> str:
    """Return the sentence about round trips through float."""
    total = sum(each.ms for each in operators) or 1.0
    text = f"The file quantizes {pairs[0]} values and dequantizes {pairs[1]} at run time"
    if not found:
        return f"{text}; no value goes from int8 to float and back without a layer in between."
    spent = sum(each.ms for each in found)
    direct = sum(not each.between for each in found)
    text += f"; {len(found)} of them go int8 -> float -> int8 with only light operators in between"
    text += f" ({direct} with none)" if direct else ""
    if not spent:
        return f"{text}. The profile shows none of them: the engine fused them, so they cost nothing."
    return f"{text}. They take {spent:.3g} ms, {spent / total:.1%} of the time."


def fallbacks_table(found: Sequence[Fallback]) -> list[dict[str, Any]]:
    """Return the ten dearest layers that fell back."""
    return [{"layer": each.layer, "what happened": each.why, "ms": round(each.ms, 4)} for each in found[:MOST]]


def fallbacks_told(found: Sequence[Fallback], operators: Sequence[Operator]) -> str:
    """Return the sentence about layers that did not run as fast int8 kernels."""
    total = sum(each.ms for each in operators) or 1.0
    if not found:
        return "Every layer that is int8 in the file runs as an int8 kernel."
    whys: dict[str, list[Fallback]] = {}
    for each in found:
        whys.setdefault(each.why, []).append(each)
    parts = []
    for why, members in whys.items():
        spent = sum(each.ms for each in members)
        parts.append(f"{len(members)} layers: {why} ({spent:.3g} ms, {spent / total:.0%} of the time)")
    return "Fell back: " + "; ".join(parts) + "."


def limit_told(
    operators: Sequence[Operator], before: Sequence[Operator], macs: Mapping[str, int], speed: float
) -> list[str]:
    """Return why int8 could not be faster: Amdahl's law on the measured time of both bundles.

    Args:
        operators: Of the bundle.
        before: Of the float32 bundle; empty when it was not found.
        macs: Precision -> multiply-accumulates of one inference of the bundle.
        speed: Measured speed-up over float32; that of the profiles when NaN.
    """
    found = []
    products = sum(each.ms for each in operators if each.product)
    total = sum(each.ms for each in operators) or 1.0
    all_macs = sum(macs.values()) or 1
    kinds = ", ".join(f"{count / all_macs:.0%} {kind}" for kind, count in macs.items() if count)
    text = f"By count the MACs are {kinds}; matrix products and convolutions take {products / total:.0%} of the time"
    text += f", at {all_macs / products / 1e6:.3g} GMAC/s" if products and macs else ""
    heavy = sum(each.ms for each in before if each.product)
    text += f" (float32: {all_macs / heavy / 1e6:.3g})" if heavy and products and macs else ""
    found.append(f"{text}.")
    if before:
        base = sum(each.ms for each in before) or 1.0
        actual = base / total if math.isnan(speed) else speed
        rest = base - heavy
        ideal, most = base / (rest + heavy / FASTER), base / rest if rest else math.inf
        text = f"In float32 they took {heavy / base:.0%} of {base:.3g} ms. By Amdahl's law products four times as"
        text += (
            f" fast make the whole {ideal:.2g}x as fast, and products for nothing {most:.2g}x; measured: {actual:.2g}x."
        )
        grown = total - products - rest
        if grown > 0.02 * total:
            text += f" What is not a product takes {grown:.2g} ms more than in float32: quantizing and moving data."
        found.append(text)
    return found


def precision_table(operators: Sequence[Operator]) -> list[dict[str, Any]]:
    """Return ms and share of the time by effective precision."""
    total = sum(each.ms for each in operators) or 1.0
    found = shares(operators)
    order = [*GROUPS, *(name for name in found if name not in GROUPS)]
    return [
        {"computed as": name, "ms": round(found[name] * total, 4), "share %": round(100 * found[name], 1)}
        for name in order
        if name in found
    ]


def candidate_row(each: Candidate, contest: Contest, where: Mapping[str, Any], source: str) -> Row:
    """Return the row of a candidate, of the bundle as it is, or of the float32 bundle."""
    measurements = []
    samples: list[float] = []
    reference = contest.baseline or contest.now
    if each.contestant is not None and reference.contestant is not None:
        samples = each.contestant.samples
        measurements = latency_measurements(samples)
        if each is not reference:
            measurements.append(speedup(each.contestant, reference.contestant))
    if not math.isnan(each.error) and each is not contest.baseline:
        note = "mean over observations of |difference|2 / |raw action|2, to float32"
        count = len(each.contestant.observations) if each.contestant else 0
        measurements.append(Measurement("raw_relative_error", each.error, "1", samples=count, note=note))
    role, reason = "subject", ""
    if each is contest.baseline:
        role = "baseline"
    elif each is contest.suggested:
        role = "chosen"
    if each.stage is not None:
        reason = command(each.stage, source)
    return Row(each.name, role, reason, tuple(measurements), {"latency_ms": samples} if samples else {}, where)


def suggested(contest: Contest, source: str) -> list[str]:
    """Return the sentence with the command that is suggested; none when nothing helps enough."""
    best = contest.suggested
    if best is None or best.stage is None:
        return []
    return [f"Do this: {command(best.stage, source)} ({_effect(best, contest.now)})."]


def tried_told(contest: Contest, worst: Sequence[LayerError]) -> list[str]:
    """Return a sentence for each candidate, with what was measured."""
    found = []
    for each in contest.others:
        names = ", ".join(f"'{short_names(worst)[layer.name]}'" for layer in worst[: each.layers])
        what = each.name.partition("without")[0] + (f"exclude {names}" if each.layers else "")
        found.append(f"Tried: {what}: {_effect(each, contest.now)}.")
    if contest.others and contest.suggested is None:
        found.append("None of these helps enough to be suggested: the error is spread over many layers.")
    return found


def _effect(each: Candidate, now: Candidate) -> str:
    """Return error and latency of a candidate beside the bundle as it is, the latency with its 95 % interval."""
    error = f"error {now.error:.2%} -> {each.error:.2%}"
    if each.contestant is None or now.contestant is None:
        return error
    ratio = speedup(now.contestant, each.contestant)  # its latency in units of the other's
    change = f"latency {ratio.value - 1:+.0%}"
    if ratio.low is None or ratio.high is None:
        return f"{error}, {change}"
    return f"{error}, {change} ({ratio.low - 1:+.0%} to {ratio.high - 1:+.0%})"
