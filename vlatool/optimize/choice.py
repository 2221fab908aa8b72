"""Which of the judged candidates is chosen, and why: in words that agree with their numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from vlatool.measures.latency import LATENCY_P50, SPEEDUP
from vlatool.measures.resources import SIZE
from vlatool.measures.success import SUCCESS
from vlatool.optimize.judge import Judged
from vlatool.optimize.ranking import TIE, first_choice, is_faster, p50, ratio
from vlatool.report import Row
from vlatool.runtime.engine import DEFAULT_ENGINE, is_installed


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
    origin, times = _times(judged, engine)
    base, inside = judged[0], [item for item in judged[1:] if item.within]
    if inside:
        faster = [item for item in inside if is_faster(item.row, base.row, origin)]
        best, reason = _best(inside, faster, base, times, origin, small)
        praised = origin == "measured"
        sentences = _praise(best, judged, best in faster, small, elsewhere) if praised else _foretell(best, judged)
    else:
        best, reason, sentences = _nearest(judged, times, origin, elsewhere)
    return mark(judged, best, reason, sentences)


def mark(judged: list[Judged], best: Judged, reason: str, sentences: tuple[str, ...]) -> list[Judged]:
    """Return the rows with that of ``best`` marked as chosen, and what is said of it."""
    chosen = replace(best, row=replace(best.row, role="chosen", reason=reason), sentences=sentences)
    return [chosen if item.row.name == best.row.name else item for item in judged]


def _times(judged: list[Judged], engine: str) -> tuple[str, dict[str, float]]:
    """Return what ranks the rows, ``measured`` or ``predicted``, and name -> median latency in ms of that origin."""
    times = {item.row.name: p50(item.row, "predicted") for item in judged} if not is_installed(engine) else {}
    if times and all(map(math.isfinite, times.values())):
        return "predicted", times
    return "measured", {item.row.name: p50(item.row) for item in judged}


def chosen_of(judged: Sequence[Judged]) -> Judged:
    """Return the row that is marked as chosen."""
    return next(item for item in judged if item.row.role == "chosen")


def _nearest(
    judged: list[Judged], times: Mapping[str, float], origin: str, elsewhere: str
) -> tuple[Judged, str, tuple[str, ...]]:
    """Return the candidate that misses the limits by least, and what is said of all of them.

    Where none could be judged, and float32 keeps to the limits, float32 is returned.
    """
    base, *quantized = judged
    best = min(quantized, key=lambda item: (item.miss, times[item.row.name]))
    missed = tuple(f"{item.row.name}: {item.row.reason}." for item in quantized)
    if base.within and math.isinf(best.miss):
        words = "no candidate could be judged"
        first = f"{base.row.name} was kept: {words}.{foretold(base.row, base.row, elsewhere)}"
        return base, f"{words}; {base.row.reason}", (first, *missed)
    sentences = (
        f"No candidate keeps to the limits; the nearest, {best.row.name}, was kept."
        + (f" It is {speed_words(best.row, base.row, elsewhere)}." if elsewhere and origin == "measured" else "")
        + foretold(best.row, base.row, elsewhere),
        *missed,
    )
    return best, f"kept as the nearest, though outside the limits: {best.row.reason}", sentences


def _best(
    inside: list[Judged], faster: list[Judged], base: Judged, times: Mapping[str, float], origin: str, small: bool
) -> tuple[Judged, str]:
    """Return the best of what keeps to the limits, and why it is.

    Args:
        faster: those that are faster than float32.
        times: name -> median latency in ms.
    """
    if base.within and not small and not faster:
        return base, f"no candidate inside the limits is faster ({origin}); {base.row.reason}"
    contest = faster if base.within and not small else inside
    best = first_choice(contest, lambda item: times[item.row.name], lambda item: item.drop)
    first = min(times[item.row.name] for item in contest)
    tied = f"within {TIE - 1:.0%} of the fastest inside the limits and the most accurate of those"
    reason = "the fastest inside the limits" if times[best.row.name] == first else tied
    if best not in faster:
        why = "memory was asked for" if small and base.within else f"{base.row.name} is outside: {base.row.reason}"
        reason = f"{reason}, though not faster than {base.row.name}: {why}"
    return best, f"{reason} ({origin}); {best.row.reason}"


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
    medians = "" if elsewhere else f"{p50(row):.4g} ms instead of {p50(base):.4g} ms, "
    here = f"{medians}measured on this host"
    if is_faster(row, base):
        return f"{times:.2f}x as fast as {base.name} ({span[2:] + '; ' if elsewhere and span else ''}{here})"
    return f"not shown to be faster than {base.name} ({times:.3g}x{span}; {here})"


def _praise(best: Judged, judged: list[Judged], faster: bool, small: bool, elsewhere: str) -> tuple[str, ...]:
    row, base = best.row, judged[0].row
    if best is judged[0]:
        return _float32_kept(judged, elsewhere)
    success = f" {_episodes(row)}." if row.get(SUCCESS) else ""
    why = ""
    if not faster:
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
