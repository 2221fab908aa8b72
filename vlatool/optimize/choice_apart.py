"""The choice where OpenVINO computes in a board's instruction set and ONNX Runtime in this host's own.

Each engine's plans are held against float32 in the same engine. Between the engines nothing that was measured here
decides, since it would be a ratio of two instruction sets: the predictions for the board do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from vlatool.machine.instruction_sets import ENGINE, BoardSet
from vlatool.measures.latency import LATENCY_P50, OPENVINO_FLOAT32_P50, SPEEDUP
from vlatool.optimize.choice import choose, chosen_of, mark, speed_words
from vlatool.optimize.judge import Judged
from vlatool.optimize.ranking import p50
from vlatool.optimize.timings import IN_OPENVINO, OWN_SET
from vlatool.report import Row


def choose_apart(
    judged: list[Judged], engines: Mapping[str, str], board: Sequence[str], where: BoardSet, small: bool = False
) -> list[Judged]:
    """Mark one row as chosen: the best of each engine by its own float32, and of those the one that is predicted best.

    Args:
        board: The board's engines, the preferred one first: they decide where predictions are missing.
        where: The set that OpenVINO is confined to.
        small: Whether memory was asked for, as for ``choose``.
    """
    base = judged[0]
    if not any(item.within for item in judged[1:]):
        return choose(judged, "", small)  # the nearest to the limits, whatever its speed
    firsts, slow = _firsts(judged, engines, small)
    contest = [*firsts.values(), *([base] if base.within and not (small and firsts) else [])]
    if not firsts:
        why = "no candidate inside the limits is faster than float32 in its own engine"
        return _kept(judged, why, *slow)
    times = {item.row.name: on_board(item.row, base.row, engines) for item in contest}
    if all(map(math.isfinite, times.values())):
        best = min(contest, key=lambda item: times[item.row.name])
        how = _by_prediction(times, engines)
    else:
        rank = {engine: index for index, engine in enumerate(board)}
        best = firsts[min(firsts, key=lambda engine: rank.get(engine, len(rank)))]
        how = "Its engine is the one that the board's profile names first: between the engines nothing was measured."
    if best is not base:
        first, *rest = best.sentences
        sentences = (first, _of_which(engines[best.row.name], where), *rest, how)
        return mark(judged, best, best.row.reason, sentences)
    return _kept(judged, "no candidate is predicted to be faster", how)


def _kept(judged: list[Judged], why: str, *sentences: str) -> list[Judged]:
    """Mark float32 as the chosen one."""
    base = judged[0]
    return mark(judged, base, f"{why}; {base.row.reason}", (f"{base.row.name} was kept: {why}.", *sentences))


def _firsts(judged: list[Judged], engines: Mapping[str, str], small: bool) -> tuple[dict[str, Judged], tuple[str, ...]]:
    """Return engine -> its best candidate, where one is faster than float32 there; and what is said of the others."""
    firsts: dict[str, Judged] = {}
    slow: list[str] = []
    for engine in dict.fromkeys(engines.values()):
        members = [item for item in judged[1:] if engines[item.row.name] == engine]
        if not any(item.within for item in members):
            continue
        ranked = choose([_reference(judged[0], engine), *members], small=small)
        best = chosen_of(ranked)
        if best is ranked[0]:
            inside = [item.row for item in members if item.within]
            slow += [f"{row.name} is {speed_words(row, best.row)}." for row in inside]
        else:
            firsts[engine] = best
    return firsts, tuple(slow)


def _reference(base: Judged, engine: str) -> Judged:
    """Return float32 as an engine runs it."""
    latency = base.row.get(OPENVINO_FLOAT32_P50)
    if engine != ENGINE or latency is None:
        return base
    rest = (other for other in base.row.measurements if other.name != LATENCY_P50.name or other.origin != "measured")
    row = replace(base.row, name=IN_OPENVINO, measurements=(LATENCY_P50.relabel(latency), *rest))
    return replace(base, row=row)


def _of_which(engine: str, where: BoardSet) -> str:
    """Say which instruction set a measured ratio is one of."""
    if engine == ENGINE:
        return f"That is a ratio of {where.ratio}."
    return f"That is a ratio of {OWN_SET} ({where.host}), not of {where.board} ({where.wanted})."


def on_board(row: Row, base: Row, engines: Mapping[str, str]) -> float:
    """Return the ms that a plan is expected to take on the board, infinite when there is no ground for it.

    What is predicted for it; for a plan of OpenVINO what is predicted for float32 there, by the measured speed-up.
    """
    reference, speedup = base.get(OPENVINO_FLOAT32_P50, "predicted"), row.value(SPEEDUP)
    if engines.get(row.name) != ENGINE or reference is None or not reference.known or not speedup > 0:
        return p50(row, "predicted")
    return reference.value / speedup


def _by_prediction(times: Mapping[str, float], engines: Mapping[str, str]) -> str:
    figures = ", ".join(f"{name} {times[name]:.3g} ms" for name in sorted(times, key=lambda name: times[name]))
    if any(engines.get(name) == ENGINE for name in times):
        figures += f"; {IN_OPENVINO} is predicted, its plans by their measured speed-ups"
    return f"Between the engines predictions for the board decided ({figures}): that was not measured."
