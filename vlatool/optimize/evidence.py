"""What is known of every candidate: latency, recorded observations, paired episodes, predictions, trainings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vlatool.accuracy.success_comparison import compare_success, with_chance
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import unknown_warning
from vlatool.data import carries_evaluation, recordings_of
from vlatool.errors import DataError, SourceError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.evaluate.recorded import Recorded
from vlatool.latency_model.predict import predictions
from vlatool.machine.instruction_sets import ENGINE, about_onnx_runtime
from vlatool.measures import series, tables, with_derived
from vlatool.measures.success import SUCCESS, SUCCESS_WRONG_INSTRUCTION
from vlatool.measures.training import TRAINING_TIME
from vlatool.optimize.build_candidates import Candidates
from vlatool.optimize.plan import BASELINE, Plan
from vlatool.optimize.ranking import in_order
from vlatool.optimize.timings import IN_OPENVINO, Timing, relabel_where, with_predictions
from vlatool.report import Measurement, Report, Row
from vlatool.stage.base import Context
from vlatool.stage.controls import reservations, training_rows
from vlatool.stage.run import cached_measure

Enough = Callable[[Row, Row], bool]
"""A candidate's row and float32's, both with their episodes -> whether no slower candidate can be chosen any more."""


@dataclass(frozen=True)
class Evidence:
    """What was measured and predicted.

    Args:
        rows: name -> row, float32 first.
        warnings: what a reader of the rows should know.
        conditions: sentences on the instruction sets that the figures are of.
    """

    rows: Mapping[str, Row]
    warnings: tuple[str, ...]
    conditions: tuple[str, ...]


def gather(
    plan: Plan, source: Bundle, candidates: Candidates, context: Context, notes: Sequence[str], enough: Enough | None
) -> Evidence:
    """Measure float32 and all candidates, and predict for the board.

    Args:
        source: policy, for the time of eager torch.
        notes: what the stages of the run noted so far; the list that those of this step are added to.
        enough: see ``with_episodes``.

    Raises:
        DataError: when the recordings or the environment cannot be used.
    """
    bundles, where, loop, cache = candidates.bundles, plan.board_set, plan.closed_loop, plan.cache
    timed, about_times = Timing(plan.recipe.effort, where, cache, context, plan.fresh).rows(source, bundles)
    rows, about_actions = with_recordings(timed, bundles, loop, cache, context)
    rows = with_episodes(rows, bundles, loop, cache, context, enough) if loop else rows
    silent = unknown_warning(source.manifest.spec)
    warnings = (*where.warnings(), *about_times, *about_actions, *silent, *dict.fromkeys(notes))
    board, apart = plan.profile, {IN_OPENVINO: ENGINE} if where.is_confined else {}
    asked = {**bundles, **dict.fromkeys(apart, bundles[BASELINE])}
    misled = {
        name: wrong_instruction(bundles[name], loop, cache, context)
        for name in ((BASELINE, *candidates.trained) if candidates.trained and loop else ())
    }
    records = (f"{name}: {line}" for name in candidates.engines for line in reservations(bundles[name]))
    trainings = {name: training_rows(candidates.stages[name]) for name in candidates.trained}
    conditions = (*about_onnx_runtime(board), *where.sentences())
    predicted = (
        {name: predictions(board, bundle, apart.get(name, "")) for name, bundle in asked.items()} if board else {}
    )

    rows = relabel_where({name: with_derived(row) for name, row in rows.items()}, candidates.engines, where)
    rows = with_predictions(rows, predicted)
    for name, found in trainings.items():
        rows[name] = _with_trainings(rows[name], found)
        rows[name] = _with_wrong_instruction(rows[name], misled.get(name), misled.get(BASELINE))
    return Evidence(rows, (*warnings, *records), conditions)


def is_recorded(bundle: Bundle, loop: ClosedLoop | None) -> bool:
    """Say whether recordings judge a bundle: its own, or where nothing else would, half of its calibration data."""
    return recordings_of(bundle).evaluation is not None or (loop is None and carries_evaluation(bundle))


def with_recordings(
    rows: Mapping[str, Row], bundles: Mapping[str, Bundle], loop: ClosedLoop | None, cache: Path, context: Context
) -> tuple[dict[str, Row], tuple[str, ...]]:
    """Return the rows with their errors on recorded observations, and what these leave unjudged of float32's actions.

    Args:
        bundles: name -> bundle; the first is the float32 baseline, which the others are held against.
    """
    (base, baseline), *_ = bundles.items()
    reports: dict[str, Report] = {
        name: cached_measure(Recorded(baseline=None if name == base else baseline.path), bundle, cache, context)
        for name, bundle in bundles.items()
        if is_recorded(bundle, loop)
    }
    measured = {name: report.rows[-1].measurements for name, report in reports.items()}
    added = {
        name: replace(row, measurements=(*row.measurements, *measured.get(name, ()))) for name, row in rows.items()
    }
    return added, reports[base].warnings if base in reports else ()


def with_episodes(
    rows: Mapping[str, Row],
    bundles: Mapping[str, Bundle],
    loop: ClosedLoop,
    cache: Path,
    context: Context,
    enough: Enough | None = None,
) -> dict[str, Row]:
    """Return the rows with what paired closed-loop episodes say of them.

    Args:
        rows: name -> row, float32 first.
        enough: Ends the episodes: candidates play in the order in which they would be chosen. All play when None.

    Raises:
        DataError: when the environment cannot be used.
    """
    base, *candidates = rows.values()
    baseline = bundles[base.name]
    own = cached_measure(loop, baseline, cache, context.about(base.name)).rows[-1]
    controls = [
        replace(cached_measure(each, baseline, cache, context).rows[-1], name=each.control) for each in loop.controls()
    ]
    evaluated, found = dict(rows), ""
    for row in (base, *(candidates if enough is None else in_order(candidates))):
        if found:
            reason = f"its episodes were not played: {found} keeps to the limits and comes before it"
            evaluated[row.name] = replace(row, reason=f"{reason} (--every-candidate plays all)")
            continue
        if row is base:
            compared = with_chance(own, controls)
        else:
            played = cached_measure(loop, bundles[row.name], cache, context.about(row.name)).rows[-1]
            compared = compare_success(own, played)
        evaluated[row.name] = _joined(row, compared)
        if enough is not None and row is not base and enough(evaluated[row.name], evaluated[base.name]):
            found = row.name
    return evaluated


def wrong_instruction(bundle: Bundle, loop: ClosedLoop | None, cache: Path, context: Context) -> Measurement | None:
    """Return how often a policy succeeds that is given the wrong instruction: one that listens hardly does.

    None for a policy that takes no text, and in an environment that knows no wrong instruction.
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


def _with_wrong_instruction(row: Row, told: Measurement | None, reference: Measurement | None) -> Row:
    """Return the row of a trained candidate with how often it succeeds when it is told the wrong instruction.

    Args:
        told: The candidate's success; None where it is not known.
    """
    if told is None or reference is None:
        return row
    said = f"{told.value:.1%} of {told.samples} episodes succeed (float32: {reference.value:.1%})"
    teachers = {
        name: [{**record, "with the wrong instruction": said} for record in records]
        for name, records in row.details.items() if tables.TEACHER.part(name) is not None
    }  # fmt: skip
    return replace(row, measurements=(*row.measurements, told), details={**row.details, **teachers})


def _with_trainings(row: Row, trained: Iterable[Row]) -> Row:
    """Return the row of a candidate with losses, rounds and times of its trainings."""
    for other in trained:
        raw = {name: values for name, values in other.raw.items() if series.LOSSES.part(name) is not None}
        details = {name: records for name, records in other.details.items() if tables.ROUNDS.part(name) is not None}
        took = TRAINING_TIME.members(other).values()
        row = replace(row, raw={**row.raw, **raw}, details={**row.details, **details},
                      measurements=(*row.measurements, *took))  # fmt: skip
    return row
