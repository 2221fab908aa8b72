"""Policies that keep values from step to step are not trained as if they did not."""

from __future__ import annotations

from pathlib import Path

import pytest
from _recurrent import recurrent_bundle

from vlatool.errors import RecipeError
from vlatool.stage.build import build_stage


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
