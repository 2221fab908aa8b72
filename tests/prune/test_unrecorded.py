"""What is chosen without a recording is said to be so, by every method that looks at observations."""

from __future__ import annotations

from dataclasses import replace

import pytest
from _deep import write_deep

from vlatool.bundle.bundle import Bundle
from vlatool.module.torch_policy import load_modules
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform


@pytest.fixture(scope="module")
def two_blocks(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy with two blocks; read only."""
    at = tmp_path_factory.mktemp("deep")
    return run_transform(TorchModule(policy=write_deep(at / "policy", layers=2)), None, at / "out", Context()).bundle


@pytest.mark.parametrize(("stage", "options", "looks"), [
    ("prune.depth", {"rank": "cosine"}, True),
    ("prune.depth", {"rank": "even"}, False),
    ("prune.structured", {"multiple": 1}, True),
    ("prune.structured", {"multiple": 1, "rank": "magnitude"}, False),
    ("prune.wanda", {}, True),
    ("prune.magnitude", {}, False),
])  # fmt: skip
@pytest.mark.parametrize("recorded", [True, False])
def test_random_observations_are_told(
    two_blocks: Bundle, stage: str, options: dict[str, object], looks: bool, recorded: bool
):
    files = {
        name: file for name, file in two_blocks.manifest.files.items() if recorded or name != "data/calibration.npz"
    }
    source = replace(two_blocks, manifest=replace(two_blocks.manifest, files=files))
    changes = build_stage(stage, {"samples": 3, **options}).change(load_modules(source), source, Context())
    told = [
        line for line in changes.messages if line.startswith("nothing is recorded: chosen by 3 random observations")
    ]
    assert len(told) == (looks and not recorded)
