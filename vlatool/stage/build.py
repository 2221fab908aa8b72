"""Stages by their names in a recipe: which there are, and one of them with its options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from vlatool import registry
from vlatool.errors import RecipeError, fix_for, suggest
from vlatool.files.printable import reason_of
from vlatool.stage.base import Stage

AnyStage = TypeVar("AnyStage", bound=Stage)
ENDS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
"""How pydantic calls the limits of a number, and how a message does."""


def stage_class(name: str) -> type[Stage]:
    """Return the class of a stage by its recipe name; raises RecipeError unless it is ``kind.name`` of a stage."""
    kind, _, entry = name.partition(".")
    known = [f"{folder}.{method}" for folder in stage_kinds() for method in registry.names(folder)]
    if name.replace("-", "_") not in known:
        raise RecipeError(f"Unknown stage '{name}'; {suggest(name, known)}.", fix_for(name, known))
    return registry.load(kind, entry)


def stage_kinds() -> tuple[str, ...]:
    """Folders that hold stages."""
    return ("sources", "export", "prune", "distill", "quantize", "benchmark", "evaluate")


def build_stage(name: str, options: Mapping[str, Any]) -> Stage:
    """Build a stage from recipe name and options; raises RecipeError naming each unknown or impossible one."""
    return stage_from(stage_class(name), options, f"stage {name}")


def stage_from(kind: type[AnyStage], options: Mapping[str, Any], where: str) -> AnyStage:
    """Build ``kind`` from options, with a sentence for each problem."""
    try:
        return kind.model_validate(dict(options))
    except ValidationError as error:
        problems = [_problem(item, kind) for item in error.errors()]
        raise RecipeError(
            f"{where}: " + "; ".join(problems) + ".", "correct what is named; docs/reference/stages.md has every option"
        ) from error


def _problem(item: Mapping[str, Any], kind: type[Stage]) -> str:
    field_name = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        return f"unknown option '{field_name}'; {suggest(field_name, list(kind.model_fields))}"
    reason = reason_of(str(item["msg"]))
    problem = f"{field_name} = {item['input']!r}: {reason[:1].lower()}{reason[1:]}"
    ends = _ends(kind, field_name) if set(item.get("ctx", {})) & set(ENDS) else []
    return f"{problem}; allowed: {', '.join(ends)}" if len(ends) > 1 else problem


def _ends(kind: type[Stage], field_name: str) -> list[str]:
    """Return the limits of a numeric option in words."""
    limits = kind.model_fields[field_name].metadata if field_name in kind.model_fields else []
    return [f"{word} {getattr(limit, end):g}" for limit in limits for end, word in ENDS.items() if hasattr(limit, end)]
