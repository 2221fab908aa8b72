"""The accuracy of every candidate: recorded observations, paired episodes, and what succeeds without looking."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from vlatool.accuracy.success_comparison import compare_success, with_chance
from vlatool.bundle.bundle import Bundle
from vlatool.data import carries_evaluation, recordings_of
from vlatool.errors import DataError, SourceError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.evaluate.recorded import Recorded
from vlatool.measures import tables
from vlatool.measures.latency import LATENCY_P50
from vlatool.measures.success import SUCCESS, SUCCESS_WRONG_INSTRUCTION
from vlatool.optimize.budget import distance_of
from vlatool.report import Measurement, Row
from vlatool.stage.base import Context
from vlatool.stage.run import cached_measure

TIE = 1.01
"""Candidates whose latencies differ by less are equally fast: two processes of one graph, in turns, differ by as much.
More would give speed away: with 5 % the search delivered what was 3 % slower than one of its own plans."""
Enough = Callable[[Row, Row], bool]
"""A candidate's row and float32's, both with their episodes -> whether no slower candidate can be chosen any more."""


def with_accuracy(
    rows: Mapping[str, Row],
    bundles: Mapping[str, Bundle],
    loop: ClosedLoop | None,
    cache: Path,
    context: Context,
    enough: Enough | None = None,
) -> dict[str, Row]:
    """Return the rows with what recordings and episodes say of them.

    Args:
        bundles: Name -> bundle; the first is the float32 baseline, which the others are held against.
        loop: The episodes; None for recordings alone.
        enough: Ends the episodes: candidates play in the order in which they would be chosen. All play when None.

    Raises:
        DataError: when the recordings or the environment cannot be used.
    """
    (base, baseline), *_ = bundles.items()
    evaluated = {
        name: replace(row, measurements=(*row.measurements, *_recorded(bundles[name], baseline, loop, cache, context)))
        for name, row in rows.items()
    }
    if loop is None:
        return evaluated
    own = cached_measure(loop, baseline, cache, context.about(base)).rows[-1]
    evaluated[base] = _joined(evaluated[base], _with_controls(loop, baseline, own, cache, context))
    others = [row for name, row in evaluated.items() if name != base]
    found = ""
    for row in others if enough is None else in_order(others):
        if found:
            reason = f"its episodes were not played: {found} keeps to the limits and comes before it"
            evaluated[row.name] = replace(row, reason=f"{reason} (--every-candidate plays all)")
            continue
        played = cached_measure(loop, bundles[row.name], cache, context.about(row.name)).rows[-1]
        evaluated[row.name] = _joined(row, compare_success(own, played))
        found = row.name if enough is not None and enough(evaluated[row.name], evaluated[base]) else ""
    return evaluated


def in_order(rows: Sequence[Row]) -> list[Row]:
    """Return candidates in the order in which they would be chosen if all kept to the limits.

    Of those that are as fast as the fastest that is left, the one nearest to float32 on recorded observations is first.
    """
    left, ordered = list(rows), []
    while left:
        least = min(_latency(row) for row in left)
        tied = [row for row in left if _latency(row) <= TIE * least] or left
        first = min(tied, key=_distance)
        ordered.append(first)
        left.remove(first)
    return ordered


def _latency(row: Row) -> float:
    latency = row.get(LATENCY_P50)
    return latency.value if latency is not None and latency.known else math.inf


def _distance(row: Row) -> float:
    distance = distance_of(row)
    return distance.value if distance is not None and distance.known else math.inf


def is_recorded(bundle: Bundle, loop: ClosedLoop | None) -> bool:
    """Say whether recordings judge a bundle: its own, or where nothing else would, half of its calibration data."""
    return recordings_of(bundle).evaluation is not None or (loop is None and carries_evaluation(bundle))


def _recorded(
    bundle: Bundle, baseline: Bundle, loop: ClosedLoop | None, cache: Path, context: Context
) -> tuple[Measurement, ...]:
    if not is_recorded(bundle, loop):
        return ()
    stage = Recorded(baseline=None if bundle is baseline else baseline.path)
    return cached_measure(stage, bundle, cache, context).rows[-1].measurements


def unjudged_actions(baseline: Bundle, loop: ClosedLoop | None, cache: Path, context: Context) -> tuple[str, ...]:
    """Return what the recordings leave unjudged of the baseline's actions, and so of any candidate's."""
    if not is_recorded(baseline, loop):
        return ()
    return cached_measure(Recorded(), baseline, cache, context).warnings


def told_wrong(bundle: Bundle, loop: ClosedLoop | None, cache: Path, context: Context) -> Measurement | None:
    """Return how often a policy succeeds that is told the wrong instruction: one that listens hardly does.

    None without episodes, for a policy that takes no text, and in an environment that knows no wrong instruction.
    """
    if loop is None or not any(tensor.kind == "text" for tensor in bundle.manifest.spec.inputs):
        return None
    context.progress("episodes with the wrong instruction", None)
    try:
        rate = cached_measure(loop.told_wrong(), bundle, cache, context).rows[-1].get(SUCCESS)
    except (DataError, SourceError):  # it played the right one: what it cannot do is another
        return None
    return rate and SUCCESS_WRONG_INSTRUCTION.relabel(rate)


def _joined(row: Row, played: Row) -> Row:
    measurements = (*row.measurements, *played.measurements)
    raw, details = {**row.raw, **played.raw}, {**row.details, **played.details}
    if lacking := [*row.details.get(tables.MISSING_VALUES, ()), *played.details.get(tables.MISSING_VALUES, ())]:
        details[tables.MISSING_VALUES] = lacking
    return replace(row, measurements=measurements, raw=raw, details=details)


def _with_controls(loop: ClosedLoop, baseline: Bundle, row: Row, cache: Path, context: Context) -> Row:
    """Play what does not look, and add how often that succeeds to the row of float32."""
    rows = []
    for control in loop.controls():
        context.progress(f"episodes of the control: {control.control} actions", None)
        played = cached_measure(control, baseline, cache, context).rows[-1]
        rows.append(replace(played, name=control.control))
    return with_chance(row, rows)
