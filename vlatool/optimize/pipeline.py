"""``optimize``: export, quantize in several ways, measure and evaluate each, keep the fastest inside the limits.

A run goes through the modules of this package in this order, and none of them imports a later one: ``recipe`` (what is
asked), ``budget``, ``plan`` (checked before anything runs), ``search`` (further plans), ``space``, ``study`` and
``pruned`` (pruned and trained policies), ``timings`` and ``evidence`` (what is measured), ``judge`` and ``choice``
(``choice_apart`` where engines cannot be compared), ``summary`` (the report).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.accuracy.credibility import Credibility, credibility
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import unknown_warning
from vlatool.errors import NOT_POSSIBLE, DataError, RecipeError, VlatoolError
from vlatool.evaluate.recorded import Recorded
from vlatool.explain.child_process import explanation_in_child
from vlatool.files.directory_writer import write_directory
from vlatool.files.messages import from_json, to_json
from vlatool.hardware.profile import Profile
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.measures import with_derived
from vlatool.measures.actions import AGREEMENT_EXPERT, ERROR_EXPERT
from vlatool.measures.success import SUCCESS, SUCCESS_DROP
from vlatool.optimize.budget import budget_of
from vlatool.optimize.build_candidates import candidate, chain
from vlatool.optimize.choice import choose, chosen_of, is_faster
from vlatool.optimize.choice_apart import choose_apart
from vlatool.optimize.evidence import Enough, is_recorded, told_wrong, unjudged_actions, with_accuracy
from vlatool.optimize.judge import Judged, judge
from vlatool.optimize.plan import BASELINE, Plan, make_plan, transforms
from vlatool.optimize.pruning_search import PrunedSearch, with_measured
from vlatool.optimize.recipe import Pruning, Recipe, StageList
from vlatool.optimize.search import Search
from vlatool.optimize.summary import report_of
from vlatool.optimize.timings import Timing, engine_of, foretold_by_engine, relabel_where
from vlatool.optimize.training_records import trainings, with_trainings, with_wrong_instruction
from vlatool.render import write_reports
from vlatool.report import Report, Row, read_report
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_names
from vlatool.stage.base import Context, OnProgress
from vlatool.stage.controls import controls, predicted_for, removed_by
from vlatool.stage.finish import reseal
from vlatool.stage.run import cached_measure, cached_transform
from vlatool.user_code import children

EXPLAIN_SECONDS = 20.0
"""What the layers' errors may take; one observation is always used."""
ROBOT_FOLDERS = ("assets", "graphs", "golden")
"""What of a bundle a robot needs; recorded data stays behind."""
Tables = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class OptimizeJob:
    """A run in a process of its own.

    Args:
        fresh: Measure again, even what was measured before.
    """

    source: str
    profile: dict[str, Any]
    recipe: dict[str, Any]
    cache: str
    draft: str
    fresh: bool
    workers: int
    command: str
    launcher: str = "processes"


def optimize(plan: Plan, out: Path, context: Context, *, force: bool = False) -> Report:
    """Run a plan and write the chosen bundle with reports and the recipe that makes it again.

    Finished stages are kept in the cache, so that an interrupted run continues where it was. Where OpenVINO must be
    confined to compute as the board does, all of it runs in a process that has the variable from its start.

    Returns:
        The report; verdict ``fail`` when no candidate keeps to the limits (the nearest one is kept, or
        float32 where none could be judged), ``inconclusive``
        when float32 does no better than actions that do not look at the observation.
    """
    with write_directory(out, force=force) as draft:
        if plan.profile and (confine := plan.board_set.to_set):
            return _confined(plan, plan.profile, confine, draft, context)
        return _optimized(plan, draft, context)


def _confined(plan: Plan, profile: Profile, confine: str, draft: Path, context: Context) -> Report:
    """Run a plan in a child whose OpenVINO, and that of its own children, is confined to an instruction set."""
    job = OptimizeJob(
        plan.typed, profile.model_dump(mode="json"), plan.recipe.model_dump(mode="json", by_alias=True),
        str(plan.cache), str(draft), plan.fresh, context.workers, context.command, context.launcher,
    )  # fmt: skip
    about = f"optimize, confined to {confine},"
    here = "vlatool.optimize.pipeline:optimize_here"
    children.call(here, to_json(job), context.progress, about, environment={MAX_CPU_ISA: confine}, own=True)
    return read_report(draft / "reports")


def optimize_here(request: Mapping[str, Any], tell: OnProgress) -> None:
    """Run an ``OptimizeJob`` in this process; its report is in the draft."""
    job = from_json(OptimizeJob, request)
    profile, recipe = Profile.model_validate(job.profile), Recipe.model_validate(job.recipe)
    plan = make_plan(job.source, profile, recipe, Path(job.cache), fresh=job.fresh)
    _optimized(plan, Path(job.draft), Context(tell, job.workers, job.command, launcher=job.launcher))


def _optimized(plan: Plan, draft: Path, context: Context) -> Report:
    """Run a plan in this process, and write everything into an empty directory."""
    source = cached_transform(plan.source, None, plan.cache, context)
    baseline = chain(plan.export, source, plan, context)[-1]
    _check_metric(plan, baseline, context)
    plan, tried = _searched(plan, baseline, context)
    plan, trials = _pruned(plan, source, baseline, context)
    bundles, failures, trained = _candidates(plan, source, baseline, context)
    rows, notes = _measured(plan, source, {BASELINE: baseline, **bundles}, context)
    rows = {name: with_trainings(row, trained.get(name, ())) for name, row in rows.items()}
    taught = [name for name in trained if trained[name]]
    rows = _told_wrong(plan, rows, {BASELINE: baseline, **bundles}, taught, context)
    judged, trust = judged_rows(plan, rows, {name: engine_of(bundle) for name, bundle in bundles.items()})
    trials = {title: with_measured(table, rows) for title, table in trials.items()}
    tables = {**trials, **tried, **_explained(judged, bundles, baseline, context)}
    judged = [_with_tables(item, tables) if item.row.role == "chosen" else item for item in judged]
    told = (
        (name, (*controls(bundle), *predicted_for(bundle), *removed_by(bundle))) for name, bundle in bundles.items()
    )
    notes = (*notes, *(f"{name}: {line}" for name, lines in told for line in lines))
    report = report_of(plan, baseline, bundles, judged, failures, notes, trust, context.command)
    chosen = chosen_of(judged).row
    _write_bundle(plan, chosen, bundles.get(chosen.name, baseline), draft)
    write_reports(report, draft / "reports")
    return report


def _check_metric(plan: Plan, baseline: Bundle, context: Context) -> None:
    """Say before the work, not after it, that a budget names what is not measured."""
    limits = plan.recipe.limits
    if not limits.metric:
        return
    if not is_recorded(baseline, plan.closed_loop):
        raise DataError(
            f"--max-drop names '{limits.metric}', which needs recorded observations; the policy brings none to be "
            "evaluated on.",
            "name evaluation.npz in policy.yaml, or give a drop in points such as 1%",
        )
    recorded = Recorded(baseline=baseline.path, samples=1)
    budget_of(limits, baseline.manifest.spec).require(cached_measure(recorded, baseline, plan.cache, context).rows[-1])


def _searched(plan: Plan, baseline: Bundle, context: Context) -> tuple[Plan, Tables]:
    """Add what the search finds to the candidates of the plan; return also the tables of what it tried."""
    if not plan.recipe.search:
        return plan, {}
    search = Search(baseline, plan.recipe.limits, plan.profile, plan.cache, context, plan.recipe.effort.threads)
    return _with_candidates(plan, search.run(plan.recipe.candidates)), search.tables()


def _pruned(plan: Plan, source: Bundle, baseline: Bundle, context: Context) -> tuple[Plan, Tables]:
    """Add the pruned policies that did best in trials to the candidates; return also a table of all trials."""
    if not plan.recipe.pruning.trials:
        return plan, {}
    found, table = PrunedSearch(plan, source, baseline, context).run()
    return _with_candidates(plan, found), table


def _with_candidates(plan: Plan, found: Mapping[str, StageList]) -> Plan:
    candidates = {**plan.recipe.candidates, **found}
    stages = {name: transforms(entries) for name, entries in candidates.items()}
    return replace(plan, recipe=plan.recipe.model_copy(update={"candidates": candidates}), candidates=stages)


def _candidates(
    plan: Plan, source: Bundle, baseline: Bundle, context: Context
) -> tuple[dict[str, Bundle], list[Row], dict[str, tuple[Row, ...]]]:
    """Make every candidate; one that cannot be made becomes a row that says why. Return also how they were trained."""
    bundles, failures, trained = {}, [], {}
    for name, stages in plan.candidates.items():
        try:
            made = candidate(stages, source, baseline, plan, context)
            bundles[name], trained[name] = made[-1], trainings(made)
        except VlatoolError as error:
            if error.exit_code not in NOT_POSSIBLE:
                raise
            failures.append(Row(name, "failed", error.message))
    if not bundles:
        raise RecipeError(
            "No candidate could be made: " + "; ".join(f"{row.name}: {row.reason}" for row in failures),
            "correct what they say, or name other candidates in a recipe: --recipe FILE",
        )
    return bundles, failures, trained


def _told_wrong(
    plan: Plan, rows: dict[str, Row], bundles: Mapping[str, Bundle], trained: Sequence[str], context: Context
) -> dict[str, Row]:
    """Add what candidates that were trained do when they are told the wrong instruction, and float32 beside them."""
    played = {
        name: told_wrong(bundles[name], plan.closed_loop, plan.cache, context)
        for name in ((BASELINE, *trained) if trained else ())
    }
    added = {name: with_wrong_instruction(rows[name], played[name], played[BASELINE]) for name in trained}
    return {**rows, **added}


def _measured(
    plan: Plan, source: Bundle, bundles: dict[str, Bundle], context: Context
) -> tuple[dict[str, Row], tuple[str, ...]]:
    """Return one row for each bundle with latency, memory, accuracy and predictions (baseline first), and warnings."""
    where = plan.board_set
    rows, warnings = Timing(plan.recipe.effort, where, plan.cache, context, plan.fresh).rows(source, bundles)
    rows = with_accuracy(rows, bundles, plan.closed_loop, plan.cache, context, _enough(plan))
    rows = {name: with_derived(row) for name, row in rows.items()}
    rows = relabel_where(rows, {name: engine_of(bundle) for name, bundle in bundles.items()}, where)
    warnings = (*warnings, *unjudged_actions(bundles[BASELINE], plan.closed_loop, plan.cache, context))
    warnings = (*warnings, *unknown_warning(source.manifest.spec), *dict.fromkeys(context.notes))
    if plan.profile:
        predicted = foretold_by_engine(plan.profile, bundles, where)
        rows = {name: replace(row, measurements=(*row.measurements, *predicted[name])) for name, row in rows.items()}
    return rows, warnings


def _enough(plan: Plan) -> Enough | None:
    """Return what ends the episodes: a candidate that keeps to the limits, where measured latencies decide."""
    board = plan.profile.engine if plan.profile else DEFAULT_ENGINE
    if plan.recipe.effort.every_candidate or plan.board_set.is_confined or board not in engine_names():
        return None

    def is_good_enough(row: Row, baseline: Row) -> bool:
        judged = judge(with_derived(row), baseline, plan.recipe.limits, plan.profile, plan.on_board)
        return judged.within and is_faster(row, baseline)

    return is_good_enough


def judged_rows(
    plan: Plan, rows: dict[str, Row], engines: Mapping[str, str] | None = None
) -> tuple[list[Judged], Credibility]:
    """Hold every row against the limits of the plan, choose one, and say whether float32 does its task.

    Args:
        rows: Name -> row with everything that was measured and predicted, float32 first.
        engines: Name -> engine of each candidate; needed where the engines cannot be compared.
    """
    on_board = plan.on_board
    judged = [judge(row, rows[BASELINE], plan.recipe.limits, plan.profile, on_board) for row in rows.values()]
    small = plan.recipe.limits.max_memory_mb is not None
    if plan.profile and plan.board_set.is_confined:
        judged = choose_apart(judged, engines or {}, tuple(plan.profile.engines), plan.board_set, small)
    else:
        elsewhere = "" if on_board else plan.board
        judged = choose(judged, plan.profile.engine if plan.profile else DEFAULT_ENGINE, small, elsewhere)
    trust = credibility(rows[BASELINE], BASELINE)
    if trust.table:
        judged[0] = _with_tables(judged[0], {"Whether the reference does its task": list(trust.table)})
    return judged, trust


def _with_tables(item: Judged, tables: Tables) -> Judged:
    return replace(item, row=replace(item.row, details={**item.row.details, **tables}))


def _explained(judged: list[Judged], bundles: dict[str, Bundle], baseline: Bundle, context: Context) -> Tables:
    """Say of the chosen bundle where its time goes and what costs its accuracy."""
    name = chosen_of(judged).row.name
    if name not in bundles:
        return {}
    sentences = explanation_in_child(bundles[name], baseline, context, samples=4, runs=10, seconds=EXPLAIN_SECONDS)
    return {"Explanation (vlatool explain says more)": [{"what": sentence} for sentence in sentences]}


def _write_bundle(plan: Plan, chosen: Row, bundle: Bundle, draft: Path) -> None:
    made_by = {**bundle.manifest.made_by, "candidate": chosen.name, "profile": plan.board}
    manifest = replace(
        bundle.manifest,
        parent=bundle.hash,
        made_by=made_by,
        accuracy=_accuracy(chosen),
        source={},
        files={graph.file: bundle.manifest.files[graph.file] for graph in bundle.manifest.graphs.values()},
    )
    reseal(bundle, draft, manifest, ROBOT_FOLDERS)
    stages = plan.recipe.candidates.get(chosen.name)
    only = {"candidates": {chosen.name: stages}, "search": False, "pruning": Pruning()}
    nowhere = plan.recipe.pruning.model_copy(update={"study": ""})  # a place of this machine, and may hold a password
    update = {"pruning": nowhere} if stages is None else only
    repeat = plan.recipe.model_copy(update=update)
    (draft / "recipe.yaml").write_text(repeat.to_yaml(), encoding="utf-8")


def _accuracy(row: Row) -> dict[str, Any]:
    """Return what the manifest says of the accuracy."""
    accuracy = {}
    for quantity in (SUCCESS, SUCCESS_DROP, AGREEMENT_EXPERT, ERROR_EXPERT):
        measured = row.get(quantity)
        if measured is not None and measured.known:
            interval = {"low": measured.low, "high": measured.high} if measured.low is not None else {}
            accuracy[quantity.name] = {"value": measured.value, **interval, "samples": measured.samples}
    return accuracy
