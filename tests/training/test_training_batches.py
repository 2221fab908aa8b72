"""Parts of a batch: the same rows and the same gradient, however many processes and parts there are."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.episodes.frames import file_of
from vlatool.training.batches import Batches
from vlatool.training.frames import Frames
from vlatool.training.group import Group
from vlatool.training.loop import Settings, Trainer
from vlatool.training.objective import Objective

ROWS = 40


@pytest.fixture
def frames(tmp_path: Path) -> Frames:
    folder = tmp_path / "round-000"
    folder.mkdir()
    random = np.random.default_rng(0)
    np.save(file_of(folder, "x"), random.standard_normal((ROWS, 3)).astype(np.float32))
    np.save(file_of(folder, "row"), np.arange(ROWS))
    frames = Frames(tmp_path)
    frames.read(0)
    return frames


def objective() -> Objective:
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(3, 8), nn.LayerNorm(8), nn.GELU(), nn.Linear(8, 1)).eval()

    def loss(rows):
        x = torch.from_numpy(rows["x"])
        return ((module(x)[:, 0] - x.sum(1)) ** 2).mean()

    return Objective("l2", {"main": module}, loss)


def trained(frames: Frames, folder: Path, accumulate: int) -> tuple[list[float], torch.Tensor]:
    folder.mkdir()
    taught = objective()
    trainer = Trainer(taught.modules, Settings(60, learning_rate=0.01, average=0.9), folder)
    trainer.train(60, Batches(taught.loss, frames, 20, accumulate, Group()), lambda _step, _loss: None)
    trainer.finish()
    return trainer.losses, torch.cat([value.reshape(-1) for value in taught.modules["main"].state_dict().values()])


@pytest.mark.parametrize("accumulate", [2, 3, 20])
def test_parts_that_follow_each_other_give_the_same_training(frames: Frames, tmp_path: Path, accumulate: int):
    whole, weights = trained(frames, tmp_path / "whole", 1)
    parts, others = trained(frames, tmp_path / "parts", accumulate)
    assert parts == pytest.approx(whole, rel=1e-3)
    assert float((weights - others).norm() / weights.norm()) < 1e-3
    assert whole[-1] < 0.5 * whole[0]


@pytest.mark.parametrize(("size", "accumulate"), [(1, 1), (1, 3), (2, 1), (3, 2), (2, 5)])
def test_processes_and_parts_share_the_same_rows(frames: Frames, size: int, accumulate: int):
    seen: list[list[int]] = []
    shares = []
    for rank in range(size):
        batches = Batches(lambda rows: seen.append(rows["row"].tolist()), frames, 11, accumulate, Group(rank, size))
        for share, compute in batches(np.random.default_rng((0, 7))):
            shares.append(share)
            compute()
    assert list(itertools.chain(*seen)) == np.random.default_rng((0, 7)).integers(ROWS, size=11).tolist()
    assert sum(shares) == pytest.approx(1.0)
    assert [len(rows) / 11 for rows in seen] == shares
    assert max(map(len, seen)) - min(map(len, seen)) <= 1
