"""Figures and choice where OpenVINO computes in a board's instruction set and ONNX Runtime in this host's own.

Each engine's plans are held against float32 in the same engine. Between the engines nothing that was measured here
decides, since it would be a ratio of two instruction sets: the predictions for the board do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from vlatool.bundle.bundle import Bundle
from vlatool.machine.instruction_sets import ENGINE, BoardSet
from vlatool.optimize.choice import choose, speed_words
from vlatool.optimize.judge import Judged, p50
from vlatool.report import Measurement, Row

REFERENCE = "openvino_float32_latency_p50"
"""Of the baseline's row: float32 in OpenVINO, of the run that timed OpenVINO's plans."""
IN_OPENVINO = "float32 in OpenVINO"
OWN_SET = "this host's own instruction set"


def joined(ours: Mapping[str, Row], theirs: Mapping[str, Row], order: Sequence[str], where: BoardSet) -> dict[str, Row]:
    """Return the rows of two runs, one for each engine, in an order.

    Args:
        ours: ONNX Runtime's plans by name, the baseline first.
        theirs: OpenVINO's plans by name, after the baseline as OpenVINO runs it.
        order: The names, the baseline first.
        where: The set that OpenVINO is confined to.
    """
    base = order[0]
    found = {name: replace(row, measurements=_told(row, OWN_SET)) for name, row in ours.items()}
    reference = theirs[base].get("latency_p50") if theirs else None
    if reference is not None:
        own = replace(reference, name=REFERENCE, where=where.where, note=f"{IN_OPENVINO}, in the run of its plans")
        found[base] = replace(found[base], measurements=(*found[base].measurements, own))
    found[base] = replace(found[base], role="baseline")  # of a run alone it is none
    found |= {name: replace(row, measurements=_told(row, where.ratio)) for name, row in theirs.items() if name != base}
    return {name: found[name] for name in order}


def _told(row: Row, what: str) -> tuple[Measurement, ...]:
    """Say of a row's speed-up what it is a ratio of."""
    of = IN_OPENVINO if what != OWN_SET else "float32 in ONNX Runtime"
    note = f"ratio of medians to {of}, interleaved: {what}"
    return tuple(replace(each, note=note) if each.name == "speedup" else each for each in row.measurements)


def placed(rows: Mapping[str, Row], engines: Mapping[str, str], where: BoardSet) -> dict[str, Row]:
    """Return the rows with OpenVINO's measurements placed where they were taken, if that is a host that is confined."""
    if not where.confined:
        return dict(rows)

    def moved(each: Measurement) -> Measurement:
        return replace(each, where=where.where) if each.origin == "measured" else each

    return {
        name: replace(row, measurements=tuple(map(moved, row.measurements))) if engines.get(name) == ENGINE else row
        for name, row in rows.items()
    }  # fmt: skip


def choose_apart(
    judged: list[Judged], engines: Mapping[str, str], board: Sequence[str], where: BoardSet, small: bool = False
) -> list[Judged]:
    """Mark one row as chosen: the best of each engine by its own float32, and of those the one that is predicted best.

    Args:
        judged: The baseline first.
        engines: Name -> engine of each candidate.
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
        told = "no candidate inside the limits is faster than float32 in its own engine"
        kept = replace(base, sentences=(f"{base.row.name} was kept: {told}.", *slow))
        return _marked(judged, base, kept, f"{told}; {base.row.reason}")
    times = {item.row.name: on_board(item.row, base.row, engines) for item in contest}
    if all(map(math.isfinite, times.values())):
        best = min(contest, key=lambda item: times[item.row.name])
        how = _by_prediction(times, engines)
    else:
        rank = {engine: place for place, engine in enumerate(board)}
        best = firsts[min(firsts, key=lambda engine: rank.get(engine, len(rank)))]
        how = "Its engine is the one that the board's profile names first: between the engines nothing was measured."
    if best is not base:
        first, *rest = best.sentences
        sentences = (first, _of_which(engines[best.row.name], where), *rest, how)
        return _marked(judged, best, replace(best, sentences=sentences), best.row.reason)
    told = "no candidate is predicted to be faster"
    return _marked(judged, base, replace(base, sentences=(f"{base.row.name} was kept: {told}.", how)),
                   f"{told}; {base.row.reason}")  # fmt: skip


def _firsts(judged: list[Judged], engines: Mapping[str, str], small: bool) -> tuple[dict[str, Judged], tuple[str, ...]]:
    """Return engine -> its best candidate, where one is faster than float32 there; and what is said of the others."""
    firsts: dict[str, Judged] = {}
    slow: list[str] = []
    for engine in dict.fromkeys(engines.values()):
        members = [item for item in judged[1:] if engines[item.row.name] == engine]
        if not any(item.within for item in members):
            continue
        found = choose([_reference(judged[0], engine), *members], small=small)
        best = next(item for item in found if item.row.role == "chosen")
        if best is found[0]:
            inside = [item.row for item in members if item.within]
            slow += [f"{row.name} is {speed_words(row, best.row)}." for row in inside]
        else:
            firsts[engine] = best
    return firsts, tuple(slow)


def _reference(base: Judged, engine: str) -> Judged:
    """Return float32 as an engine runs it."""
    found = base.row.get(REFERENCE)
    if engine != ENGINE or found is None:
        return base
    rest = (each for each in base.row.measurements if each.name != "latency_p50" or each.origin != "measured")
    row = replace(base.row, name=IN_OPENVINO, measurements=(replace(found, name="latency_p50"), *rest))
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
    found, speedup = base.get(REFERENCE, "predicted"), row.value("speedup")
    if engines.get(row.name) != ENGINE or found is None or not found.known or not speedup > 0:
        return p50(row, "predicted")
    return found.value / speedup


def _by_prediction(times: Mapping[str, float], engines: Mapping[str, str]) -> str:
    told = ", ".join(f"{name} {times[name]:.3g} ms" for name in sorted(times, key=lambda name: times[name]))
    by = (
        f"; {IN_OPENVINO} is predicted, its plans by their measured speed-ups"
        if any(engines.get(name) == ENGINE for name in times)
        else ""
    )
    return f"Between the engines predictions for the board decided ({told}{by}): that was not measured."


def _marked(judged: list[Judged], item: Judged, chosen: Judged, reason: str) -> list[Judged]:
    """Return the list with one item replaced by what is said of it as the chosen one."""
    best = replace(chosen, row=replace(chosen.row, role="chosen", reason=reason))
    return [best if each.row.name == item.row.name else each for each in judged]


def in_int8(bundles: Mapping[str, Bundle], engines: Mapping[str, str]) -> dict[str, str]:
    """Return the engines of the bundles that multiply in int8, by name; weights alone in int8 are none."""
    return {
        name: engines[name]
        for name, bundle in bundles.items()
        if any("int8" in graph.precision for graph in bundle.manifest.graphs.values())
    }


def about_int8(rows: Mapping[str, Row], engines: Mapping[str, str], where: BoardSet) -> tuple[str, ...]:
    """Say of a board without VNNI that int8 may lose, and how the fastest int8 plan of OpenVINO did; else nothing."""
    if not where.saturates:
        return ()
    told = (
        f"{where.board} has no VNNI: int8 products are added in pairs of 16 bits there, which can saturate, and int8 "
    )
    told += "may be slower than float32. "
    if not (where.confined or where.alike):
        return (f"{told}Whether it is was not measured: OpenVINO does not compute in that set here.",)
    told += "It was tried all the same: "
    tried = {name: found for name, row in rows.items()
             if engines.get(name) == ENGINE and (found := row.get("speedup"))}  # fmt: skip
    if not tried:
        return (f"{told}no int8 plan of OpenVINO could be made.",)
    name, found = max(tried.items(), key=lambda pair: pair[1].value)
    low, high = found.low or found.value, found.high or found.value
    verdict = "it loses there" if high < 1 else "it wins there" if low > 1 else "it is not shown to win there"
    of = f"{IN_OPENVINO}, of {where.ratio}" if where.confined else "float32"
    return (f"{told}{name} is {found.value:.2f}x ({low:.2f} to {high:.2f}) as fast as {of}; {verdict}.",)
