"""``optimize``: export, quantize in several ways, measure and evaluate each, keep the fastest inside the limits.

A run is a list of steps (``_optimized``), each in the module that it is about; what one step returns is a frozen value
that the next ones take, and the plan stays as it was checked.

1. ``build_candidates.chain``: the policy in float32.
2. ``_proposals``: the candidates of the recipe, with what ``search`` and ``pruning_search`` find.
3. ``build_candidates.build``: a bundle of each, or why there is none.
4. ``evidence.gather``: what is measured of each, and predicted for the board.
5. ``decision.decide``: each held against the limits, one of them chosen, and whether float32 does its task.
6. ``result``: the report, the bundle, and the recipe that makes it again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError
from vlatool.evaluate.recorded import Recorded
from vlatool.explain.child_process import explanation_in_child
from vlatool.files.directory_writer import write_directory
from vlatool.files.messages import from_json, to_json
from vlatool.hardware.profile import Profile
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.module.source import OWN_RECORDINGS, RecordingOptions
from vlatool.optimize.budget import budget_of
from vlatool.optimize.build_candidates import build, chain
from vlatool.optimize.decision import Tables, decide, enough_for
from vlatool.optimize.evidence import gather, is_recorded
from vlatool.optimize.plan import Plan, Transforms, make_plan, transforms
from vlatool.optimize.pruning_search import PrunedSearch, with_measured
from vlatool.optimize.recipe import Recipe, StageList
from vlatool.optimize.result import summarize, write_bundle, write_recipe
from vlatool.optimize.search import Search
from vlatool.render import write_reports
from vlatool.report import Report, read_report
from vlatool.stage.base import Context, OnProgress
from vlatool.stage.run import cached_measure, cached_transform
from vlatool.user_code import children

EXPLAIN_SECONDS = 20.0
"""What the layers' errors may take; one observation is always used."""


@dataclass(frozen=True)
class OptimizeJob:
    """A run in a process of its own."""

    source: str
    profile: dict[str, Any]
    recipe: dict[str, Any]
    cache: str
    draft: str
    fresh: bool
    workers: int
    command: str
    launcher: str = "processes"
    recordings: RecordingOptions = OWN_RECORDINGS


@dataclass(frozen=True)
class Proposals:
    """What is to be built, and what was tried to find it.

    Args:
        candidates: name -> stages, as a recipe names them.
        transforms: the same stages, built.
        trials: tables of the trials of pruned policies.
        plans: tables of the plans that the search tried.
    """

    candidates: Mapping[str, StageList]
    transforms: Mapping[str, Transforms]
    trials: Tables
    plans: Tables


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
        plan.recordings,
    )  # fmt: skip
    about = f"optimize, confined to {confine},"
    here = "vlatool.optimize.pipeline:optimize_here"
    children.call(here, to_json(job), context.progress, about, environment={MAX_CPU_ISA: confine}, own=True)
    return read_report(draft / "reports")


def optimize_here(request: Mapping[str, Any], tell: OnProgress) -> None:
    """Run an ``OptimizeJob`` in this process; its report is in the draft."""
    job = from_json(OptimizeJob, request)
    profile, recipe = Profile.model_validate(job.profile), Recipe.model_validate(job.recipe)
    plan = make_plan(job.source, profile, recipe, Path(job.cache), job.recordings, fresh=job.fresh)
    _optimized(plan, Path(job.draft), Context(tell, job.workers, job.command, launcher=job.launcher))


def _optimized(plan: Plan, draft: Path, context: Context) -> Report:
    """Run a plan in this process, and write everything into an empty directory."""
    notes: list[str] = []
    context = replace(context, note=notes.append)
    source = cached_transform(plan.source, None, plan.cache, context).bundle
    baseline = chain(plan.export, source, plan.profile, plan.recipe.limits.accept, plan.cache, context)[-1]
    _check_metric(plan, baseline, context)
    proposals = _proposals(plan, source, baseline, context)
    candidates = build(proposals.transforms, source, baseline, plan, context)
    evidence = gather(plan, source, candidates, context, notes, enough_for(plan))
    decision = decide(plan, evidence.rows, candidates.engines)
    chosen = candidates.bundles[decision.choice.row.name]
    trials = {title: with_measured(table, evidence.rows) for title, table in proposals.trials.items()}
    explained = {} if chosen is baseline else _explained(chosen, baseline, context)
    decision = decision.with_tables({**trials, **proposals.plans, **explained})
    report = summarize(plan, candidates, evidence, decision, context.command)
    write_recipe(plan.recipe, proposals.candidates, decision.choice.row.name, draft)
    write_bundle(chosen, decision.choice.row, plan.board, draft)
    write_reports(report, draft / "reports")
    return report


def _check_metric(plan: Plan, baseline: Bundle, context: Context) -> None:
    """Say before the work, not after it, that a budget names what is not measured."""
    limits = plan.recipe.limits
    if not limits.metric:
        return
    budget = budget_of(limits, baseline.manifest.spec)
    if not is_recorded(baseline, plan.closed_loop):
        budget.check_name(baseline.manifest.spec.action)
        raise DataError(
            f"--max-drop names '{limits.metric}', which needs recorded observations; the policy brings none to be "
            "evaluated on.",
            "name evaluation.npz in policy.yaml, or give a drop in points such as 1%",
        )
    recorded = Recorded(baseline=baseline.path, samples=1)
    row = cached_measure(recorded, baseline, plan.cache, context).rows[-1]
    budget.require(row)


def _proposals(plan: Plan, source: Bundle, baseline: Bundle, context: Context) -> Proposals:
    """Return the candidates of the recipe, with what the search finds, and the pruned policies that did best."""
    recipe = plan.recipe
    candidates: dict[str, StageList] = recipe.candidates
    trials: Tables = {}
    plans: Tables = {}
    if recipe.search:
        search = Search(baseline, recipe.limits, plan.profile, plan.cache, context, recipe.effort.threads)
        candidates = {**candidates, **search.run(candidates)}
        plans = search.tables()
    if recipe.pruning.trials:
        found, trials = PrunedSearch(plan, source, baseline, context).run(candidates)
        candidates = {**candidates, **found}
    return Proposals(candidates, {name: transforms(stages) for name, stages in candidates.items()}, trials, plans)


def _explained(chosen: Bundle, baseline: Bundle, context: Context) -> Tables:
    """Say of the chosen bundle where its time goes and what costs its accuracy."""
    sentences = explanation_in_child(chosen, baseline, context, samples=4, runs=10, seconds=EXPLAIN_SECONDS)
    return {"Explanation (vlatool explain says more)": [{"what": sentence} for sentence in sentences]}
