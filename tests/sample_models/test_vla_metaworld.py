"""The sample policy vla-metaworld: what its training does in a step."""

import copy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

METAWORLD = Path(__file__).parents[2] / "sample_models/vla-metaworld"


@pytest.fixture
def imported(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """The sample's own modules, as its scripts import them; gone afterwards, for other folders have the same names."""
    for folder in (METAWORLD,):
        for file in folder.glob("*.py"):  # another policy's, left behind by whatever ran before
            monkeypatch.delitem(sys.modules, file.stem, raising=False)
    before = set(sys.modules)
    monkeypatch.setattr(sys, "path", [str(METAWORLD), *sys.path])
    from batches import Batches, Budget
    from demonstrations import Frames
    from learning import Learner

    yield SimpleNamespace(Learner=Learner, Batches=Batches, Budget=Budget, Frames=Frames)
    for name in set(sys.modules) - before:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).is_relative_to(METAWORLD):
            del sys.modules[name]


def test_the_average_follows_the_weights_and_is_what_is_saved(imported: SimpleNamespace, tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    frames = imported.Frames(
        random.integers(256, size=(2, 96, 96, 3), dtype=np.uint8), random.random((2, 4), np.float32),
        random.random((2, 8, 4), np.float32), np.arange(2), np.arange(2),
    )  # fmt: skip
    learner = imported.Learner(0, imported.Budget(1, float("inf")))
    before = copy.deepcopy(learner.policy)
    batches = imported.Batches.read(frames, METAWORLD, 0)
    batches.draw = lambda: imported.Batches.draw(batches, 2)
    learner.run(batches, 1.0, lambda *_: None)
    assert learner.step == 1
    trained = dict(learner.policy.named_parameters())
    assert any(not torch.equal(value, trained[name]) for name, value in before.named_parameters())
    learner.save(tmp_path / "weights.safetensors")
    saved = load_file(tmp_path / "weights.safetensors")
    for name, value in before.named_parameters():
        wanted = value + (1 - 2 / 11) * (trained[name] - value)
        torch.testing.assert_close(saved[name], wanted.detach().half(), rtol=2e-3, atol=1e-6)
