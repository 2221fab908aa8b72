"""What a run leaves behind: the chosen bundle, as a robot needs it, and the recipe that makes it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.measures.actions import AGREEMENT_EXPERT, ERROR_EXPERT
from vlatool.measures.success import SUCCESS, SUCCESS_DROP
from vlatool.optimize.recipe import Pruning, Recipe, StageList
from vlatool.report import Row
from vlatool.stage.finish import reseal

ROBOT_FOLDERS = ("assets", "graphs", "golden")
"""What of a bundle a robot needs; recorded data stays behind."""


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
