"""Weights that become zero while they are trained, and stay so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.prune._sparse_base import smallest_mask
from vlatool.training.constraint import GrowingZeros
from vlatool.training.loop import Settings, Trainer

SHARES = {5: 0.25, 10: 0.5, 20: 0.75}


def net() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(4, 8), nn.GELU(), nn.Linear(8, 1)).eval()


def trainer_of(folder: Path) -> tuple[nn.Module, Trainer]:
    module = net()
    zeros = GrowingZeros(
        [module[0].weight], lambda sizes, share: smallest_mask(sizes, "unstructured", share, rows=False), SHARES
    )
    return module, Trainer({"main": module}, Settings(30, 0.03, average=0.9), folder, constraint=zeros)


def train(module: nn.Module, trainer: Trainer, until: int) -> None:
    def draw(random: np.random.Generator):
        rows = torch.from_numpy(random.standard_normal((16, 4)).astype(np.float32))
        yield 1.0, lambda: ((module(rows)[:, 0] - rows.sum(1)) ** 2).mean()

    trainer.train(until, draw, lambda _step, _loss: None)


def test_zeros_are_added_when_they_are_due_and_stay(tmp_path: Path):
    module, trainer = trainer_of(tmp_path)
    before = torch.zeros(8, 4, dtype=torch.bool)
    for step in range(1, 31):
        sizes = module[0].weight.detach().abs().clone()
        train(module, trainer, step)
        zero = module[0].weight == 0
        count = max((share for at, share in SHARES.items() if at <= step), default=0.0) * 32
        assert int(zero.sum()) == count
        assert bool((zero | ~before).all()), "what was zero is zero"
        if step in SHARES and bool((zero & ~before).any()):
            moved = 2 * 0.03  # a step changes a weight by the learning rate at most, one up and one down
            assert float(sizes[zero & ~before].max()) < float(sizes[~zero].min()) + moved, "the smallest went"
        before = zero.clone()
    assert int((module[2].weight == 0).sum()) == 0, "other weights are free"
    trainer.finish()
    assert int((module[0].weight == 0).sum()) == 24, "the average has the same zeros"


@pytest.mark.parametrize("stops", [(3, 5, 6), (10, 19, 20, 29)])
def test_a_run_that_is_killed_goes_on_to_the_bit(tmp_path: Path, stops: tuple[int, ...]):
    (tmp_path / "whole").mkdir()
    (tmp_path / "pieces").mkdir()
    module, trainer = trainer_of(tmp_path / "whole")
    train(module, trainer, 30)
    trainer.finish()
    for until in (*stops, 30):
        other, again = trainer_of(tmp_path / "pieces")
        train(other, again, until)
        again.save()
    again.finish()
    assert all(torch.equal(value, other.state_dict()[name]) for name, value in module.state_dict().items())
