"""What a run leaves behind: the report on what was chosen and why, the bundle, and the recipe that makes it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import pip_install
from vlatool.machine.host import fingerprint
from vlatool.machine.instruction_sets import ENGINE, BoardSet
from vlatool.measures.actions import AGREEMENT_EXPERT, ERROR_EXPERT
from vlatool.measures.latency import SPEEDUP
from vlatool.measures.success import SUCCESS, SUCCESS_DROP
from vlatool.optimize.build_candidates import Candidates, engine_of
from vlatool.optimize.decision import Decision
from vlatool.optimize.evidence import Evidence
from vlatool.optimize.moves import slower_task
from vlatool.optimize.plan import BASELINE, Plan
from vlatool.optimize.recipe import Pruning, Recipe, StageList
from vlatool.optimize.timings import IN_OPENVINO, utc_now
from vlatool.report import ON_BOARD, Report, Row
from vlatool.runtime.engine import DEFAULT_ENGINE
from vlatool.stage.finish import reseal

ROBOT_FOLDERS = ("assets", "graphs", "golden")
"""What of a bundle a robot needs; recorded data stays behind."""


def summarize(plan: Plan, candidates: Candidates, evidence: Evidence, decision: Decision, command: str) -> Report:
    """Return the report."""
    chosen, trust, where = decision.choice, decision.trust, plan.board_set
    rows = {item.row.name: item.row for item in decision.judged}
    judged = (text for item in decision.judged for text in item.warnings)
    warnings = (*evidence.warnings, *trust.warnings, *judged)
    return Report(
        "optimize",
        f"{candidates.bundles[BASELINE].manifest.name} for {plan.board}",
        decision.verdict,
        summary=(
            *trust.sentences, *chosen.sentences, *filter(None, [slower_task(chosen.row)]), *filter(None, [trust.floor]),
            *about_int8(rows, in_int8(candidates.bundles), where), *evidence.conditions,
            *_needs(engine_of(candidates.bundles[chosen.row.name])),
        ),
        rows=(*rows.values(), *candidates.failures),
        limits=_limits(plan),
        command=command,
        created=utc_now(),
        environment={**fingerprint(), **({ON_BOARD: plan.board} if plan.profile and plan.on_board else {})},
        warnings=tuple(dict.fromkeys(warnings)),
    )  # fmt: skip


def _limits(plan: Plan) -> dict[str, float | str]:
    """Return the limits that were asked for, each with its unit in the name."""
    limits = plan.recipe.limits
    drop = "max_success_drop_points" if plan.closed_loop else "max_drop_points"
    accuracy = {limits.metric: limits.max_metric} if limits.metric else {drop: 100 * limits.max_drop}
    distance = {} if limits.metric else {"max_distance_percent": 100 * limits.max_distance}
    named = {
        **accuracy, "hz": limits.hz, "profile": plan.board, "max_latency_ms": limits.max_latency_ms,
        "max_memory_mb": limits.max_memory_mb, **distance,
        "max_motion_percent": None if limits.max_motion is None else 100 * limits.max_motion,
        "worst_task_drop_points": None if limits.worst_task is None else 100 * limits.worst_task,
    }  # fmt: skip
    return {name: value for name, value in named.items() if value is not None}


def in_int8(bundles: Mapping[str, Bundle]) -> dict[str, str]:
    """Return the engines of the bundles that multiply in int8, by name; weights alone in int8 do not count."""
    return {
        name: engine_of(bundle)
        for name, bundle in bundles.items()
        if any("int8" in graph.precision for graph in bundle.manifest.graphs.values())
    }


def about_int8(rows: Mapping[str, Row], engines: Mapping[str, str], where: BoardSet) -> tuple[str, ...]:
    """Say of a board without VNNI that int8 may lose, and how the fastest int8 plan of OpenVINO did; else nothing."""
    if not where.saturates:
        return ()
    words = (
        f"{where.board} has no VNNI: int8 products are added in pairs of 16 bits there, which can saturate, and int8 "
        "may be slower than float32. "
    )
    if not (where.is_confined or where.same_set):
        return (f"{words}Whether it is was not measured: OpenVINO does not compute in that set here.",)
    words += "It was tried all the same: "
    tried = {name: speedup for name, row in rows.items()
             if engines.get(name) == ENGINE and (speedup := row.get(SPEEDUP))}  # fmt: skip
    if not tried:
        return (f"{words}no int8 plan of OpenVINO could be made.",)
    name, fastest = max(tried.items(), key=lambda pair: pair[1].value)
    low, high = fastest.low or fastest.value, fastest.high or fastest.value
    verdict = "it loses there" if high < 1 else "it wins there" if low > 1 else "it is not shown to win there"
    of = f"{IN_OPENVINO}, of {where.ratio}" if where.is_confined else "float32"
    return (f"{words}{name} is {fastest.value:.2f}x ({low:.2f} to {high:.2f}) as fast as {of}; {verdict}.",)


def _needs(engine: str) -> tuple[str, ...]:
    """Say what the robot must have installed beside the default engine."""
    if engine == DEFAULT_ENGINE:
        return ()
    return (f"It runs on the engine {engine}: {pip_install(engine, 'vlatool-runtime')} on the robot.",)


def write_bundle(bundle: Bundle, chosen: Row, board: str, draft: Path) -> None:
    """Write the chosen bundle, without what a robot does not need, into an empty directory.

    Args:
        board: name of the profile, or of what stands in for it.
    """
    manifest = replace(
        bundle.manifest,
        parent=bundle.hash,
        made_by={**bundle.manifest.made_by, "candidate": chosen.name, "profile": board},
        accuracy=_accuracy(chosen),
        source={},
        files={graph.file: bundle.manifest.files[graph.file] for graph in bundle.manifest.graphs.values()},
    )
    reseal(bundle, draft, manifest, ROBOT_FOLDERS)


def write_recipe(recipe: Recipe, candidates: Mapping[str, StageList], chosen: str, draft: Path) -> None:
    """Write the recipe that makes the chosen candidate again, or all of them where float32 was kept."""
    only = {"candidates": {chosen: candidates.get(chosen)}, "search": False, "pruning": Pruning()}
    nowhere = {"pruning": recipe.pruning.model_copy(update={"study": ""})}  # of this machine, and may hold a password
    repeat = recipe.model_copy(update=only if chosen in candidates else {"candidates": dict(candidates), **nowhere})
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
