"""``vlatool optimize``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.cli import _complete
from vlatool.cli._console import crew, file_or_none, progress, raise_verdict, refuse_existing, terminal_text
from vlatool.cli._document import answer, document, put, report_document
from vlatool.cli._options import Force, MapNames, Workers
from vlatool.cli._proposal import propose
from vlatool.cli._torchrun import launch_for
from vlatool.errors import UsageError
from vlatool.files.outputs import BUNDLE
from vlatool.files.printable import mask_passwords
from vlatool.machine.host import isa
from vlatool.report import REPORT, Report
from vlatool.runtime.engine import DEFAULT_ENGINE

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile
    from vlatool.optimize.plan import Plan
    from vlatool.optimize.recipe import Pruning, Recipe
    from vlatool.sources import Source
    from vlatool.stage.base import Stage

TRAINS = "distill.policy"

PolicySource = Annotated[
    str,
    typer.Argument(
        help="policy directory, path.py:make, or a file that holds a policy: .onnx, .pt, .pt2, LEAPP",
        show_default=False,
        autocompletion=_complete.sources,
    ),
]
Board = Annotated[
    str | None,
    typer.Option(
        help="board to optimise for (see: vlatool profiles list); this host if unset", autocompletion=_complete.profiles
    ),
]
Drop = Annotated[str | None, typer.Option(help="largest drop against float32: 1% (default), METRIC=VALUE, or 0.002m")]
Distance = Annotated[
    str | None, typer.Option(help="largest distance from float32's own actions, by their spread (25%)")
]
Motion = Annotated[
    str | None, typer.Option(help="largest growth of jerk, path and task time where both succeed, such as 5%")
]
WorstTask = Annotated[str | None, typer.Option(help="largest drop in any single task, such as 3%")]
Accept = Annotated[
    list[str] | None, typer.Option(help="overrule a finding of a candidate by its name (see: vlatool inspect)")
]
Trials = Annotated[
    int | None, typer.Option(min=0, help="policies to prune, train, quantize and try (0; needs the extra 'search')")
]
EnvironmentTimeout = Annotated[
    float | None, typer.Option(min=0, max=1e6, help="seconds that a call of the environment may take (300)")
]
EveryCandidate = Annotated[
    bool | None,
    typer.Option("--every-candidate", help="play the episodes of every candidate, not only until one is chosen"),
]
StudyPlace = Annotated[
    str | None, typer.Option(help="file or database URL that stores the trials, so that several machines share them")
]
Calibration = Annotated[
    Path | None, typer.Option(help="recording or dataset to calibrate with, instead of what policy.yaml names")
]
Evaluation = Annotated[
    Path | None, typer.Option(help="recording or dataset to evaluate on; of --calibration a half is held out if unset")
]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON on stdout: the report, or the plan with --dry-run")]


def optimize(
    source: PolicySource,
    output: Annotated[Path, typer.Option("-o", "--output", help="directory of the new bundle", show_default=False)],
    profile: Board = None,
    calibration: Calibration = None,
    evaluation: Evaluation = None,
    map_names: MapNames = None,
    max_drop: Drop = None,
    max_distance: Distance = None,
    max_motion: Motion = None,
    worst_task: WorstTask = None,
    hz: Annotated[float | None, typer.Option(min=0.001, help="inferences per second that the board must reach")] = None,
    max_latency_ms: Annotated[float | None, typer.Option(min=0.001, help="largest latency of one inference")] = None,
    max_memory_mb: Annotated[float | None, typer.Option(min=1, help="largest memory of the process")] = None,
    accept: Accept = None,
    search: Annotated[
        bool | None, typer.Option("--search/--no-search", help="search for faster plans (default without --recipe)")
    ] = None,
    trials: Trials = None,
    train_steps: Annotated[int | None, typer.Option(min=1, help="updates in the training of each trial (1500)")] = None,
    study: StudyPlace = None,
    recipe: Annotated[Path | None, typer.Option(help="recipe.yaml: candidates, limits and effort")] = None,
    episodes: Annotated[int | None, typer.Option(min=0, help="closed-loop episodes of each candidate (200)")] = None,
    environment_timeout: EnvironmentTimeout = None,
    every_candidate: EveryCandidate = None,
    iterations: Annotated[int | None, typer.Option(min=20, help="timed inferences of each candidate (200)")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="threads while timing (1)")] = None,
    workers: Workers = None,
    cache: Annotated[Path | None, typer.Option(help="where finished stages are kept")] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="measure again, without stored measurements")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="print the plan and stop")] = False,
    force: Force = False,
    as_json: AsJson = False,
    raw: Annotated[bool, typer.Option("--raw", help="keep every raw sample in the JSON of --json")] = False,
) -> None:
    """Export a policy, quantize it in several ways, measure and evaluate each, and keep the fastest inside the budget.

    Exits 0 when a candidate keeps to the limits, 1 when none does (the nearest one is kept), and 5 when float32 does no
    better than actions that ignore the observation, so that it cannot serve as a reference.
    """
    from vlatool.hardware.profile import load_profile
    from vlatool.module.source import RecordingOptions
    from vlatool.optimize import pipeline
    from vlatool.optimize.plan import make_plan
    from vlatool.sources import source_stage
    from vlatool.stage.run import cache_directory

    launch_for("vlatool optimize", trains=False)
    if not dry_run:
        inputs = (source, recipe, file_or_none(profile), cache, calibration, evaluation)
        refuse_existing(output, force, *inputs, kind=BUNDLE)
    board = load_profile(profile) if profile else None
    shares = {"max_distance": max_distance, "max_motion": max_motion, "worst_task": worst_task}
    board_limits = {"hz": hz, "max_latency_ms": max_latency_ms, "max_memory_mb": max_memory_mb}
    asked = _limits(max_drop, shares, accept, board_limits)
    effort: Any = {"episodes": episodes, "iterations": iterations, "threads": threads,
                   "every_candidate": every_candidate, "environment_timeout": environment_timeout}  # fmt: skip
    recordings = RecordingOptions(str(calibration or ""), str(evaluation or ""), tuple(map_names or ()))
    chosen = _recipe(recipe, source_stage(source).with_recordings(recordings), board, asked, _given(effort))
    pruning = _pruning(chosen.pruning, trials, train_steps, study)
    chosen = chosen.model_copy(update={"pruning": pruning, **_given({"search": search})})
    plan = make_plan(source, board, chosen, cache or cache_directory(), recordings, fresh=fresh)
    if dry_run:
        answer(as_json, plan_document(plan), plan.lines())
        return
    with progress(*crew(workers)) as context:
        report = pipeline.optimize(plan, output, context, force=force)
    propose(source, Bundle.open(output, verify=False).manifest, output)
    _show(report, output, as_json, raw)
    raise_verdict(report)


def _given(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that were given."""
    return {name: value for name, value in options.items() if value is not None}


def _show(report: Report, output: Path, as_json: bool, raw: bool) -> None:
    """Print a report, as JSON or in short."""
    if as_json:
        document(report_document(report, raw=raw, file=output / "reports" / REPORT))
        return
    put(terminal_text(report, brief=True))
    put(f"bundle: {output}\nreport: {output / 'reports' / 'report.html'}\n")


def _limits(
    max_drop: str | None, shares: dict[str, str | None], accept: list[str] | None, numbers: dict[str, float | None]
) -> dict[str, Any]:
    """Return the limits that were given: field of ``Limits`` -> value."""
    limits: dict[str, Any] = {} if max_drop is None else budget(max_drop)
    limits |= {name: share(text, f"--{name.replace('_', '-')}") for name, text in shares.items() if text is not None}
    for name, value in numbers.items():
        if value is not None and not math.isfinite(value):
            raise UsageError(
                f"--{name.replace('_', '-')} is {value}; allowed: a number above 0.",
                "give a number above 0, or leave the option out",
            )
        limits |= {} if value is None else {name: value}
    return limits | ({"accept": tuple(accept)} if accept else {})


def _recipe(
    file: Path | None, source: Source, board: Profile | None, limits: dict[str, Any], effort: dict[str, Any]
) -> Recipe:
    """Return the recipe of a file, or the default one, with the limits and the effort that were given."""
    from vlatool.optimize.recipe import Effort, Limits, default_recipe, read_recipe
    from vlatool.sources import brings_calibration

    if file is None:
        engine = board.engine if board else DEFAULT_ENGINE
        features = board.units[board.engines[engine].unit].isa if board else isa() or ()
        return default_recipe(Limits(**limits), Effort(**effort), brings_calibration(source), engine, features)
    recipe = read_recipe(file)
    update = {"limits": recipe.limits.model_copy(update=limits), "effort": recipe.effort.model_copy(update=effort)}
    return recipe.model_copy(update=update)


def _pruning(pruning: Pruning, trials: int | None, steps: int | None, study: str | None) -> Pruning:
    """Return what a recipe says of trials with the options that were given."""
    if study is not None and not study.strip():
        raise UsageError("--study names no place.", "name a file or the address of a database, or leave it out")
    update: dict[str, Any] = {"trials": trials, "study": study}
    if steps is not None:
        recover = [{name: {**(options or {}), "steps": steps} if name == TRAINS else options}
                   for stage in pruning.recover for name, options in stage.items()]  # fmt: skip
        if not any(TRAINS in stage for stage in recover):
            raise UsageError(
                f"--train-steps is of {TRAINS}, which the recipe does not name under pruning.recover.",
                "leave --train-steps out, or name one of them under pruning.recover",
            )
        update["recover"] = tuple(recover)
    return pruning.model_copy(update=_given(update))


def budget(text: str) -> dict[str, Any]:
    """Read ``1%``, ``0.01``, ``METRIC=VALUE`` (with a unit or without), or ``0.002m``; raises UsageError otherwise."""
    named = re.fullmatch(r"\s*([A-Za-z_][\w.]*)\s*=\s*([0-9]*\.?[0-9]+(?:e-?[0-9]+)?)\s*(%?)\s*", text)
    if named:
        return {"metric": named[1], "max_metric": float(named[2]) / (100 if named[3] else 1)}
    physical = re.fullmatch(r"\s*([0-9]*\.?[0-9]+(?:e-?[0-9]+)?)\s*([A-Za-z][A-Za-z/]*)\s*", text)
    if physical:
        return {"metric": f"unit:{physical[2]}", "max_metric": float(physical[1])}
    return {"max_drop": share(text), "metric": "", "max_metric": None}


def share(text: str, option: str = "--max-drop") -> float:
    """Read ``1%`` or ``0.01`` as a share; raises UsageError for anything else, or outside 0-100 %."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(%?)\s*", text)
    value = float(match[1]) / (100 if match[2] else 1) if match else -1.0
    if not 0 <= value <= 1:
        more = ", METRIC=VALUE such as relative_error=0.04, or an action error such as 0.002m"
        raise UsageError(
            f"{option} is '{text}'; allowed: a percentage such as 1%, a share from 0 to 1 such as 0.01"
            f"{more if option == '--max-drop' else ''}.",
            f"write it as {option} 1%",
        )
    return value


def plan_document(plan: Plan) -> dict[str, Any]:
    """Return what ``plan.lines()`` says, as values that JSON can say."""
    effort, loop, pruning = plan.recipe.effort, plan.closed_loop, plan.recipe.pruning
    plain = {
        "source": {"policy": str(plan.source.policy) if plan.source.policy else None, **_stage(plan.source)},
        "export": _stages(plan.export),
        "candidates": {name: _stages(stages) for name, stages in plan.candidates.items()},
        "search": plan.recipe.search,
        "pruning": {**pruning.model_dump(mode="json"), "study": mask_passwords(pruning.study)},
        "benchmark": {"iterations": effort.iterations, "threads": effort.threads},
        "evaluate": {"recorded": True, "episodes": loop.episodes if loop else 0},
        "limits": plan.recipe.limits.model_dump(mode="json", exclude_none=True),
        "profile": plan.profile.name if plan.profile else None,
        "computes": plan.board_set.plan() or None,
        "cache": str(plan.cache),
    }
    return {"plan": plain}


def _stages(stages: Iterable[Stage]) -> list[dict[str, Any]]:
    return [_stage(stage) for stage in stages]


def _stage(stage: Stage) -> dict[str, Any]:
    return {"stage": stage.name(), "options": stage.options()}
