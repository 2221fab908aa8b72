"""Policies that keep values from step to step are not trained, and not ranked, as if they did not."""

from __future__ import annotations

from pathlib import Path

import pytest
from _recurrent import recurrent_bundle

from vlatool.errors import RecipeError
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform


@pytest.mark.parametrize(("stage", "options"), [
    ("quantize.qat", {}), ("prune.gradual", {}), ("distill.policy", {"teacher": "delayed"}),
    ("distill.policy", {"student": "width=0.5"}),
])  # fmt: skip
def test_training_on_single_observations_is_refused(tmp_path: Path, stage: str, options: dict[str, str]):
    source = recurrent_bundle(tmp_path / "elman", "elman")
    if "teacher" in options:
        options = {"teacher": str(recurrent_bundle(tmp_path / "delayed", "delayed").path)}
    with pytest.raises(RecipeError, match="keeps 'memory' from step to step") as caught:
        build_stage(stage, options).check(source, None)
    assert "prune neurons" in caught.value.fix or "--teacher" in caught.value.fix


@pytest.mark.parametrize("stage", ["structured", "sparsegpt", "wanda"])
def test_ranking_on_single_observations_is_refused(tmp_path: Path, stage: str):
    source = recurrent_bundle(tmp_path / "hidden", "hidden")
    with pytest.raises(RecipeError, match="keeps 'memory' from step to step") as caught:
        run_transform(build_stage(f"prune.{stage}", {}), source, tmp_path / "out", Context())
    assert "magnitude" in caught.value.fix
    run_transform(build_stage(f"prune.{'structured' if stage == 'structured' else 'magnitude'}",
                              {"rank": "magnitude"} if stage == "structured" else {}),
                  source, tmp_path / "magnitude", Context())  # fmt: skip
