"""``optimize``: export, quantize in several ways, measure and evaluate each, keep the fastest inside the limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.accuracy.credibility import Credibility, credibility
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, RecipeError, VlatoolError, install
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.evaluate.recorded import Recorded
from vlatool.explain import explanation
from vlatool.files.writing import writing
from vlatool.hardware.profile import Profile
from vlatool.machine.host import MAX_CPU_ISA, fingerprint, matches
from vlatool.machine.instruction_sets import BoardSet, about_onnx_runtime, board_set
from vlatool.module.description import read_description
from vlatool.optimize.choice import choose
from vlatool.optimize.engines_apart import about_int8, choose_apart, in_int8, placed
from vlatool.optimize.evidence import is_recorded, unjudged, with_accuracy
from vlatool.optimize.judge import Judged, budget_of, judge
from vlatool.optimize.recipe import Limits, Recipe, stage_entries
from vlatool.optimize.search import Search
from vlatool.optimize.timings import Timing, engine_of, foretold_by_engine, now
from vlatool.render import write_reports
from vlatool.report import ON_BOARD, Report, Row, read_report
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.runtime.policy import refuse_findings
from vlatool.sources import Source, source_stage
from vlatool.stage.base import Context, Stage, Tell, Transform, build_stage
from vlatool.stage.finish import reseal
from vlatool.stage.run import cached_measure, cached_transform
from vlatool.user_code import children

BASELINE = "float32"
EXPLAIN_SECONDS = 20.0
"""What the layers' errors may take; one observation is always used."""
ROBOT_FOLDERS = ("assets", "graphs", "golden")
"""What of a bundle a robot needs; recorded data stays behind."""


@dataclass(frozen=True)
class Plan:
    """Everything that ``optimize`` will do, checked, before anything runs."""

    source: Source
    export: tuple[Transform, ...]
    candidates: dict[str, tuple[Transform, ...]]
    recipe: Recipe
    profile: Profile | None
    cache: Path
    fresh: bool = False
    typed: str = ""

    @property
    def board_set(self) -> BoardSet:
        """What OpenVINO computes in on the board, beside what it computes in here."""
        return board_set(self.profile)

    @property
    def board(self) -> str:
        """Name of the profile, or of what stands in for it."""
        return self.profile.name if self.profile else "this host"

    @property
    def on_board(self) -> bool:
        """Whether this host is the board, so that what is measured here holds there."""
        return self.profile is None or matches(self.profile.model_strings, fingerprint())

    @property
    def closed_loop(self) -> ClosedLoop | None:
        """The closed-loop evaluation, None when the policy names no environment or no episodes are wanted."""
        if self.source.policy is None or not self.recipe.effort.episodes:
            return None
        described = read_description(self.source.policy)
        if not described.environment:
            return None
        return ClosedLoop(policy=self.source.policy, episodes=self.recipe.effort.episodes)

    def lines(self) -> Iterator[str]:
        """Describe the plan, a line for each stage."""
        yield f"source      {self.source.name()} {self.source.policy or ''}".rstrip()
        for stage in self.export:
            yield f"export      {stage.name()} {_options(stage)}".rstrip()
        for name, stages in self.candidates.items():
            yield f"candidate   {name}: " + ", ".join(f"{stage.name()} {_options(stage)}".rstrip() for stage in stages)
        effort = self.recipe.effort
        yield f"benchmark   {effort.iterations} inferences of each, interleaved, {effort.threads} thread(s), this host"
        loop = self.closed_loop
        yield "evaluate    recorded observations" + (f", {loop.episodes} paired closed-loop episodes" if loop else "")
        limits = self.recipe.limits
        if self.recipe.search:
            yield "search      engines, methods, mixed-precision plans; the fastest inside the budget become candidates"
        yield f"limits      {', '.join(_limits(limits))}"
        told = " (predicted, unless this host is that board)" if self.profile else " (measured)"
        yield f"profile     {self.board}{told}"
        if computed := self.board_set.plan():
            yield f"computes    {computed}"
        yield f"cache       {self.cache}"


def make_plan(source: str, profile: Profile | None, recipe: Recipe, cache: Path, *, fresh: bool = False) -> Plan:
    """Build and check every stage; nothing has run when this returns.

    Args:
        source: See ``source_stage``.
        profile: The board; None for this host.
        recipe: Candidates, limits and effort.
        cache: Where finished stages are kept.
        fresh: Measure again, even what was measured before.

    Raises:
        VlatoolError: for the first thing that cannot work.
    """
    stage = source_stage(source)
    stage.check(None, profile)
    export = () if stage.has_graphs else _transforms(recipe.export)
    candidates = {name: _transforms(stages) for name, stages in recipe.candidates.items()}
    for name, stages in candidates.items():
        changing = [stage.takes_modules for stage in stages]
        if changing != sorted(changing, reverse=True) or any(stage.kind() == "export" for stage in stages):
            raise RecipeError(
                f"The candidate '{name}' changes modules after a graph was made, or exports.",
                "put the stages of prune and distill first, and options of the export under 'export'",
            )
        if name == BASELINE or not name.replace("_", "").replace("-", "").isalnum():
            raise RecipeError(f"A candidate cannot be called '{name}'; use letters, digits, '-' and '_'.")
    return Plan(stage, export, candidates, recipe, profile, cache, fresh, source)


def optimize(plan: Plan, out: Path, context: Context, *, force: bool = False) -> Report:
    """Run a plan and write the chosen bundle with reports and the recipe that makes it again.

    Finished stages are kept in the cache, so that an interrupted run continues where it was. Where OpenVINO must be
    confined to compute as the board does, all of it runs in a process that has the variable from its start.

    Returns:
        The report; verdict ``fail`` when no candidate keeps to the limits (the nearest one is kept, or
        float32 where none could be judged), ``inconclusive``
        when float32 does no better than actions that do not look at the observation.
    """
    with writing(out, force=force) as draft:
        if plan.profile and (confine := plan.board_set.to_set):
            return _confined(plan, plan.profile, confine, draft, context)
        return _optimized(plan, draft, context)


def _confined(plan: Plan, profile: Profile, confine: str, draft: Path, context: Context) -> Report:
    """Run a plan in a child whose OpenVINO, and that of its own children, is confined to an instruction set."""
    job = {
        "source": plan.typed, "profile": profile.model_dump(mode="json"), "cache": str(plan.cache),
        "recipe": plan.recipe.model_dump(mode="json", by_alias=True), "fresh": plan.fresh, "draft": str(draft),
        "workers": context.workers, "command": context.command,
    }  # fmt: skip
    about = f"optimize, confined to {confine},"
    confined = {MAX_CPU_ISA: confine}
    children.call("vlatool.optimize.pipeline:optimize_here", job, context.tell, about, environment=confined, own=True)
    return read_report(draft / "reports")


def optimize_here(job: Mapping[str, Any], tell: Tell) -> None:
    """Run the plan of a job in this process; its report is in the draft."""
    profile, recipe = Profile.model_validate(job["profile"]), Recipe.model_validate(job["recipe"])
    plan = make_plan(job["source"], profile, recipe, Path(job["cache"]), fresh=job["fresh"])
    _optimized(plan, Path(job["draft"]), Context(tell, job["workers"], job["command"]))


def _optimized(plan: Plan, draft: Path, context: Context) -> Report:
    """Run a plan in this process, and write everything into an empty directory."""
    source = cached_transform(plan.source, None, plan.cache, context)
    baseline = _chain(plan.export, source, plan, context)
    _check_metric(plan, baseline, context)
    plan, searched = _searched(plan, baseline, context)
    bundles, failures = _candidates(plan, source, baseline, context)
    rows, warnings = _measure(plan, source, {BASELINE: baseline, **bundles}, context)
    engines = {name: engine_of(bundle) for name, bundle in bundles.items()}
    judged, trust = judged_rows(plan, rows, engines)
    tables = {**searched, **_explained(judged, bundles, baseline, context)}
    judged = [_with_tables(item, tables) if item.row.role == "chosen" else item for item in judged]
    chosen = next(item.row for item in judged if item.row.role == "chosen")
    chosen_bundle = baseline if chosen.name == BASELINE else bundles[chosen.name]
    report = _report(plan, baseline, judged, failures, warnings, trust, context)
    where = plan.board_set
    told = (*about_int8(rows, in_int8(bundles, engines), where), *about_onnx_runtime(plan.profile), *where.sentences())
    report = replace(report, summary=(*report.summary, *told, *_needs(chosen_bundle)))
    _write_bundle(plan, chosen, chosen_bundle, draft)
    write_reports(report, draft / "reports")
    return report


def judged_rows(
    plan: Plan, rows: dict[str, Row], engines: Mapping[str, str] | None = None
) -> tuple[list[Judged], Credibility]:
    """Hold every row against the limits of the plan, choose one, and say whether float32 does its task.

    Args:
        plan: With limits and board.
        rows: Name -> row with everything that was measured and predicted, float32 first.
        engines: Name -> engine of each candidate; needed where the engines cannot be compared.
    """
    on_board = plan.on_board
    judged = [judge(row, rows[BASELINE], plan.recipe.limits, plan.profile, on_board) for row in rows.values()]
    small = plan.recipe.limits.max_memory_mb is not None
    if plan.profile and plan.board_set.confined:
        judged = choose_apart(judged, engines or {}, tuple(plan.profile.engines), plan.board_set, small)
    else:
        elsewhere = "" if on_board else plan.board
        judged = choose(judged, plan.profile.engine if plan.profile else DEFAULT_ENGINE, small, elsewhere)
    trust = credibility(rows[BASELINE], BASELINE)
    if trust.table:
        judged[0] = _with_tables(judged[0], {"Whether the reference does its task": list(trust.table)})
    return judged, trust


def verdict_of(judged: list[Judged], trust: Credibility) -> str:
    """Return ``pass``, ``fail``, or ``inconclusive`` where nothing can be held against the reference."""
    chosen = next(item for item in judged if item.row.role == "chosen")
    kept = chosen.within and any(item.within for item in judged[1:])
    return "inconclusive" if trust.fails else "pass" if kept else "fail"


def _needs(bundle: Bundle) -> tuple[str, ...]:
    """Say what the robot must have installed beside the default engine."""
    engine = bundle.manifest.engine
    if engine in ("", DEFAULT_ENGINE):
        return ()
    return (f"It runs on the engine {engine}: {install(engine, 'vlatool-runtime')} on the robot.",)


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
    budget_of(limits, baseline.manifest.spec).found(cached_measure(recorded, baseline, plan.cache, context).rows[-1])


def _with_tables(item: Judged, tables: dict[str, list[dict[str, Any]]]) -> Judged:
    return replace(item, row=replace(item.row, details={**item.row.details, **tables}))


def _explained(
    judged: list[Judged], bundles: dict[str, Bundle], baseline: Bundle, context: Context
) -> dict[str, list[dict[str, Any]]]:
    """Say of the chosen bundle where its time goes and what costs its accuracy."""
    name = next(item.row.name for item in judged if item.row.role == "chosen")
    if name not in bundles:
        return {}
    sentences = explanation(bundles[name], baseline, context, samples=4, runs=10, seconds=EXPLAIN_SECONDS)
    return {"Explanation (vlatool explain says more)": [{"what": sentence} for sentence in sentences]}


def _searched(plan: Plan, baseline: Bundle, context: Context) -> tuple[Plan, dict[str, list[dict[str, Any]]]]:
    """Add what the search finds to the candidates of the plan; return also the tables of what it tried."""
    if not plan.recipe.search:
        return plan, {}
    search = Search(baseline, plan.recipe.limits, plan.profile, plan.cache, context, plan.recipe.effort.threads)
    found = search.run(plan.recipe.candidates)
    candidates = {**plan.recipe.candidates, **found}
    recipe = plan.recipe.model_copy(update={"candidates": candidates})
    stages = {name: _transforms(entries) for name, entries in candidates.items()}
    return replace(plan, recipe=recipe, candidates=stages), search.tables()


def _limits(limits: Limits) -> list[str]:
    """Return the limits in words."""
    drop = f"drop <= {100 * limits.max_drop:g} points"
    told = [f"{limits.metric} <= {limits.max_metric:g}" if limits.metric else drop]
    told += [f"{limits.hz:g} Hz"] if limits.hz else []
    told += [f"latency <= {limits.max_latency_ms:g} ms"] if limits.max_latency_ms else []
    told += [f"memory <= {limits.max_memory_mb:g} MB"] if limits.max_memory_mb else []
    return told + ([] if limits.metric else [f"distance from float32 <= {100 * limits.max_distance:g} %"])


def _transforms(stages: Any) -> tuple[Transform, ...]:
    built = []
    for name, options in stage_entries(stages):
        stage = build_stage(name, options or {})
        if stage.kind() == "sources":
            raise RecipeError(f"The stage {name} reads a policy; the policy is named on the command line.")
        if not isinstance(stage, Transform):
            raise RecipeError(f"The stage {name} measures; a recipe lists stages that make a bundle.")
        built.append(stage)
    return tuple(built)


def _chain(stages: tuple[Transform, ...], source: Bundle, plan: Plan, context: Context) -> Bundle:
    bundle = source
    for stage in stages:
        context.tell(stage.name(), None)
        stage.check(bundle, plan.profile)
        bundle = cached_transform(stage, bundle, plan.cache, context)
    refuse_findings(bundle, plan.recipe.limits.accept)
    return bundle


def _candidates(plan: Plan, source: Bundle, baseline: Bundle, context: Context) -> tuple[dict[str, Bundle], list[Row]]:
    """Make every candidate; one that cannot be made becomes a row that says why.

    What changes the policy's modules starts at the source, and is exported after that.
    """
    bundles, failures = {}, []
    for name, stages in plan.candidates.items():
        try:
            changed = stages[: sum(stage.takes_modules for stage in stages)]
            start = _chain((*changed, *plan.export), source, plan, context) if changed else baseline
            bundles[name] = _chain(stages[len(changed) :], start, plan, context)
        except VlatoolError as error:
            if error.exit_code not in (3, 4):
                raise
            failures.append(Row(name, "failed", error.message))
    if not bundles:
        raise RecipeError("No candidate could be made: " + "; ".join(f"{row.name}: {row.reason}" for row in failures))
    return bundles, failures


def _measure(
    plan: Plan, source: Bundle, bundles: dict[str, Bundle], context: Context
) -> tuple[dict[str, Row], tuple[str, ...]]:
    """Return one row for each bundle with latency, memory, accuracy and predictions (baseline first), and warnings."""
    where = plan.board_set
    rows, warnings = Timing(plan.recipe.effort, where, plan.cache, context, plan.fresh).rows(source, bundles)
    rows = with_accuracy(rows, bundles, plan.closed_loop, plan.cache, context)
    rows = placed(rows, {name: engine_of(bundle) for name, bundle in bundles.items()}, where)
    warnings = (*warnings, *unjudged(bundles[BASELINE], plan.closed_loop, plan.cache, context))
    if plan.profile:
        foretold = foretold_by_engine(plan.profile, bundles, where)
        rows = {name: replace(row, measurements=(*row.measurements, *foretold[name])) for name, row in rows.items()}
    return rows, warnings


def _report(
    plan: Plan,
    baseline: Bundle,
    judged: list[Judged],
    failures: list[Row],
    notes: tuple[str, ...],
    trust: Credibility,
    context: Context,
) -> Report:
    rows = tuple(item.row for item in judged) + tuple(failures)
    chosen = next(item for item in judged if item.row.role == "chosen")
    wanted = plan.recipe.limits
    name = "max_success_drop_points" if plan.closed_loop else "max_drop_points"
    limits = {name: 100 * wanted.max_drop, "hz": wanted.hz, "profile": plan.board}
    if wanted.metric:
        limits = {wanted.metric: wanted.max_metric, "hz": wanted.hz, "profile": plan.board}
    limits |= {"max_latency_ms": wanted.max_latency_ms, "max_memory_mb": wanted.max_memory_mb}
    limits |= {} if wanted.metric else {"max_distance_percent": 100 * wanted.max_distance}
    warnings = tuple(
        dict.fromkeys(
            [
                *plan.board_set.warnings(),
                *notes,
                *trust.warnings,
                *(warning for item in judged for warning in item.warnings),
            ]
        )
    )
    return Report(
        "optimize",
        f"{baseline.manifest.name} for {plan.board}",
        verdict_of(judged, trust),
        summary=(*trust.sentences, *chosen.sentences, *filter(None, [trust.floor])),
        rows=rows,
        limits={key: value for key, value in limits.items() if value is not None},
        command=context.command,
        created=now(),
        environment={**fingerprint(), **({ON_BOARD: plan.board} if plan.profile and plan.on_board else {})},
        warnings=warnings,
    )


def _write_bundle(plan: Plan, chosen: Row, bundle: Bundle, draft: Path) -> None:
    accuracy = {}
    for name in ("success", "success_drop", "agreement_expert", "error_expert"):
        found = chosen.get(name)
        if found is not None and found.known:
            interval = {"low": found.low, "high": found.high} if found.low is not None else {}
            accuracy[name] = {"value": found.value, **interval, "samples": found.samples}
    made_by = {**bundle.manifest.made_by, "candidate": chosen.name, "profile": plan.board}
    manifest = replace(
        bundle.manifest,
        parent=bundle.hash,
        made_by=made_by,
        accuracy=accuracy,
        source={},
        files={graph.file: bundle.manifest.files[graph.file] for graph in bundle.manifest.graphs.values()},
    )
    reseal(bundle, draft, manifest, ROBOT_FOLDERS)
    stages = plan.recipe.candidates.get(chosen.name)
    only = {"candidates": {chosen.name: stages}, "search": False}
    repeat = plan.recipe if stages is None else plan.recipe.model_copy(update=only)
    (draft / "recipe.yaml").write_text(repeat.to_yaml(), encoding="utf-8")


def _options(stage: Stage) -> str:
    return " ".join(f"{key}={value}" for key, value in stage.options().items())
