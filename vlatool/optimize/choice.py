"""Which of the judged candidates is chosen, and why: in words that agree with their numbers."""

from __future__ import annotations

import math
from dataclasses import replace

from vlatool.measures.latency import LATENCY_P50, SPEEDUP
from vlatool.measures.resources import SIZE
from vlatool.measures.success import SUCCESS
from vlatool.optimize.evidence import TIE
from vlatool.optimize.judge import Judged, p50
from vlatool.report import Row
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_names

MIN_RATIO = 1.005
"""Ratio of the medians from which on two decimals do not say 1.00."""


def choose(
    judged: list[Judged], engine: str = DEFAULT_ENGINE, small: bool = False, elsewhere: str = ""
) -> list[Judged]:
    """Mark one row as chosen: the fastest inside the limits, or the nearest to them when none is inside.

    A candidate is faster than float32 when the interval of its measured speed-up says so; where none is, float32 stays.
    Of candidates within ``TIE`` of the fastest, which timing noise cannot tell apart, the most accurate is chosen, and
    of equally accurate ones the first, so that a repeated run chooses the same.

    Args:
        small: Whether memory was asked for: float32 is then no answer while a smaller plan keeps to the limits.
        engine: The engine of the board. When it is not the one that was measured here, predictions for the board rank
            the candidates, where every candidate has one.
        elsewhere: The board that the candidates are for, when it is not this host: its milliseconds are told, and not
            this host's.
    """
    origin = "measured"
    if engine not in engine_names() and all(p50(item.row, "predicted") < float("inf") for item in judged):
        origin = "predicted"
    inside = [item for item in judged if item.row.role != "baseline" and item.within]
    if not inside:
        best, reason, sentences = _nearest(judged, origin, elsewhere)
    else:
        best, reason = _best(inside, judged[0], origin, small)
        praised = origin == "measured"
        sentences = _praise(best, judged, small, elsewhere) if praised else _foretell(best, judged)
    chosen = replace(best, row=replace(best.row, role="chosen", reason=reason), sentences=sentences)
    return [chosen if item is best else item for item in judged]


def chosen_of(judged: list[Judged]) -> Judged:
    """Return the row that is marked as chosen."""
    return next(item for item in judged if item.row.role == "chosen")


def _nearest(judged: list[Judged], origin: str, elsewhere: str) -> tuple[Judged, str, tuple[str, ...]]:
    """Return the candidate that misses the limits by least, and what is said of all of them.

    Where none could be judged, and float32 keeps to the limits, float32 is returned.
    """
    quantized = [item for item in judged if item.row.role != "baseline"]
    best, base = min(quantized, key=lambda item: (item.miss, p50(item.row, origin))), judged[0]
    missed = tuple(f"{item.row.name}: {item.row.reason}." for item in quantized)
    if base.within and math.isinf(best.miss):
        words = "no candidate could be judged"
        first = f"{base.row.name} was kept: {words}.{foretold(base.row, base.row, elsewhere)}"
        return base, f"{words}; {base.row.reason}", (first, *missed)
    sentences = (
        f"No candidate keeps to the limits; the nearest, {best.row.name}, was kept."
        + (f" It is {speed_words(best.row, judged[0].row, elsewhere)}." if elsewhere and origin == "measured" else "")
        + foretold(best.row, judged[0].row, elsewhere),
        *missed,
    )
    return best, f"kept as the nearest, though outside the limits: {best.row.reason}", sentences


def _best(inside: list[Judged], base: Judged, origin: str, small: bool) -> tuple[Judged, str]:
    """Return the best of what keeps to the limits, and why it is."""
    contest = inside
    if base.within and not small:
        faster = [item for item in inside if is_faster(item.row, base.row, origin)]
        if not faster:
            return base, f"no candidate inside the limits is faster ({origin}); {base.row.reason}"
        contest = faster
    best = _fastest(contest, origin)
    first = min(p50(item.row, origin) for item in contest)
    tied = f"within {TIE - 1:.0%} of the fastest inside the limits and the most accurate of those"
    reason = "the fastest inside the limits" if p50(best.row, origin) == first else tied
    if not is_faster(best.row, base.row, origin):
        why = "memory was asked for" if small and base.within else f"{base.row.name} is outside: {base.row.reason}"
        reason = f"{reason}, though not faster than {base.row.name}: {why}"
    return best, f"{reason} ({origin}); {best.row.reason}"


def is_faster(row: Row, base: Row, origin: str = "measured") -> bool:
    """Say whether a row is faster than float32.

    Measured: the interval of the speed-up lies above 1, and the speed-up that is printed does not round to 1.00.
    Predicted: the prediction is; intervals of predictions for one board overlap, since they share their error.
    """
    if ratio(row, base, origin) < MIN_RATIO:
        return False
    speedup = row.get(SPEEDUP)
    return origin == "predicted" or (speedup is not None and speedup.low is not None and speedup.low > 1.0)


def ratio(row: Row, base: Row, origin: str = "measured") -> float:
    """Return how many times as fast a row is as another: its speed-up, or the quotient of medians; 0 when unknown."""
    if origin == "measured" and (speedup := row.get(SPEEDUP)) is not None and speedup.known:
        return speedup.value
    own, reference = p50(row, origin), p50(base, origin)
    return reference / own if 0 < own < float("inf") and reference < float("inf") else 0.0


def _fastest(items: list[Judged], origin: str) -> Judged:
    least = min(p50(item.row, origin) for item in items)
    tied = [item for item in items if p50(item.row, origin) <= TIE * least] or items
    return min(tied, key=lambda item: item.drop)


def _times(row: Row, base: Row) -> str:
    return f"{p50(row):.4g} ms instead of {p50(base):.4g} ms, measured on this host"


def foretold(row: Row, base: Row, elsewhere: str) -> str:
    """Return a sentence on what a row is predicted to need on a board, with its range; empty without a board."""
    latency = row.get(LATENCY_P50, "predicted")
    if not elsewhere:
        return ""
    if latency is None or not latency.known:
        return f" No latency can be predicted for {elsewhere}."
    span = (
        ""
        if latency.low is None or latency.high is None
        else f" ({latency.low:.3g} to {latency.high:.3g}, {latency.confidence:.0%})"
    )
    reference = base.get(LATENCY_P50, "predicted")
    beside = f", {base.name} {reference.value:.3g} ms" if row is not base and reference and reference.known else ""
    return f" Predicted for {elsewhere}, not measured there: {latency.value:.3g} ms{span}{beside}."


def speed_words(row: Row, base: Row, elsewhere: str = "") -> str:
    """Return ``1.32x as fast as float32 (...)``, or that it is not faster, with the numbers for it.

    Args:
        elsewhere: The board that it is for, when it is not this host: only the ratio is told, as the table has it.
    """
    speedup = row.get(SPEEDUP)
    known = speedup is not None and speedup.low is not None and speedup.high is not None
    span = f"; {speedup.low:.2f} to {speedup.high:.2f}" if speedup and known else ""
    times = ratio(row, base)
    here = "measured on this host" if elsewhere else _times(row, base)
    if is_faster(row, base):
        return f"{times:.2f}x as fast as {base.name} ({span[2:] + '; ' if elsewhere and span else ''}{here})"
    return f"not shown to be faster than {base.name} ({times:.3g}x{span}; {here})"


def _praise(best: Judged, judged: list[Judged], small: bool, elsewhere: str) -> tuple[str, ...]:
    row, base = best.row, judged[0].row
    if best is judged[0]:
        return _float32_kept(judged, elsewhere)
    success = f" {_episodes(row)}." if row.get(SUCCESS) else ""
    why = ""
    if not is_faster(row, base):
        reason = "memory was asked for" if small and judged[0].within else f"{base.name} is outside: {base.reason}"
        why = f" It was chosen because {reason}."
    board = foretold(row, base, elsewhere)
    first = f"{row.name} is {speed_words(row, base, elsewhere)}; {_size(row, base)}.{why}{success}{board}"
    return (first, _reason(row))


def _size(row: Row, base: Row) -> str:
    return f"its graphs take {row.value(SIZE):.3g} MB instead of {base.value(SIZE):.3g} MB"


def _episodes(row: Row) -> str:
    success = row.get(SUCCESS)
    return f"{success.value:.1%} of {success.samples} closed-loop episodes succeed" if success else ""


def _reason(row: Row) -> str:
    return f"{row.reason[:1].upper()}{row.reason[1:]}."


def _float32_kept(judged: list[Judged], elsewhere: str) -> tuple[str, ...]:
    base = judged[0].row
    outside = [item for item in judged[1:] if not item.within and is_faster(item.row, base)]
    inside = [item for item in judged[1:] if item.within]
    speeds = tuple(f"{item.row.name} is {speed_words(item.row, base, elsewhere)}." for item in inside)
    board = foretold(base, base, elsewhere)
    if outside:
        return (
            f"{base.name} was kept: no candidate inside the limits is faster on this host.{board}",
            *speeds,
            *(f"{item.row.name} is faster, but outside: {item.row.reason}." for item in outside),
        )
    return (
        f"{base.name} was kept: no quantized candidate is faster on this host.{board}",
        *speeds,
        "In a graph this small the quantize and dequantize steps can cost more than int8 arithmetic saves.",
    )


def _foretell(best: Judged, judged: list[Judged]) -> tuple[str, ...]:
    """Say what was chosen by prediction, since this host cannot run the board's engine."""
    row, base = best.row, judged[0].row
    if best is judged[0]:
        return (f"{base.name} was kept: no candidate inside the limits is predicted to be faster; not measured there.",)
    own, reference = row.get(LATENCY_P50, "predicted"), base.get(LATENCY_P50, "predicted")
    if own is None or reference is None:
        return (f"{row.name} was chosen.",)
    low, high = own.low or own.value, own.high or own.value
    times = ratio(row, base, "predicted")
    faster = is_faster(row, base, "predicted")
    speed = f"{times:.2f}x as fast as {base.name}" if faster else f"not faster than {base.name} ({times:.3g}x)"
    here = f" Measured on this host: {_size(row, base)}"
    here += f", and {_episodes(row)}" if row.get(SUCCESS) else ""
    overlap = ""
    if faster and reference.low is not None and reference.low < high:
        overlap = f" (whose range, {reference.low:.4g} to {reference.high or reference.value:.4g} ms, overlaps)"
    return (
        f"{row.name} is predicted to need {own.value:.4g} ms ({low:.4g} to {high:.4g}) on {own.where}, "
        f"{speed}{overlap}; not measured there.{here}.",
        _reason(row),
        "The board's engine does not run on this host: the latencies measured here are ONNX Runtime's on this CPU.",
    )
