"""The plan of ``vlatool optimize --dry-run`` as JSON."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from vlatool.files.printable import mask_passwords

if TYPE_CHECKING:
    from vlatool.optimize.plan import Plan
    from vlatool.stage.base import Stage


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
