"""A loss of several terms: their gradients add up, each is measured at some steps, and a kill changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.training.loop import Settings, Trainer
from vlatool.training.mixture import Mixture

STEPS = 20
LOOKED_AT = [2, 11, 20]
"""Numbers of the steps after 5, 50 and 95 %."""


def net() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 8), nn.GELU(), nn.Linear(8, 1)).eval()


def draw_for(module: nn.Module, goal: float):
    """Draws three parts of a batch; the loss is the square of the distance from a goal."""

    def draw(random: np.random.Generator):
        rows = torch.from_numpy(random.standard_normal((9, 3)).astype(np.float32))
        for part in rows.split(3):
            yield 1 / 3, lambda part=part: ((module(part) - goal) ** 2).mean()

    return draw


def trainer_of(module: nn.Module, folder: Path, steps: int = STEPS) -> Trainer:
    folder.mkdir(exist_ok=True)
    return Trainer({"main": module}, Settings(steps, learning_rate=0.01), folder)


def trained(folder: Path, stops: tuple[int, ...] = (), mixed: bool = True) -> Trainer:
    for until in (*stops, STEPS):
        module = net()
        trainer, draw = trainer_of(module, folder), Mixture([(0.7, draw_for(module, 1)), (0.3, draw_for(module, -1))])
        trainer.train(until, draw if mixed else lambda random, draw=draw: draw(random), lambda _step, _loss: None)
        trainer.save()
    return trainer


def test_it_is_the_sum_of_its_terms(tmp_path: Path):
    mixed, plain = trained(tmp_path / "mixed"), trained(tmp_path / "plain", mixed=False)
    assert [step for step, *_ in mixed.gradient_norms] == LOOKED_AT
    assert plain.gradient_norms == []
    assert mixed.losses == pytest.approx(plain.losses, rel=1e-5)
    assert mixed.losses[0] == plain.losses[0]


def test_a_run_that_is_killed_goes_on_to_the_same_looks(tmp_path: Path):
    whole, pieces = trained(tmp_path / "whole"), trained(tmp_path / "pieces", (1, 2, 12))
    assert pieces.gradient_norms == whole.gradient_norms
    assert pieces.losses == whole.losses
    assert len(whole.gradient_norms) == 3


def test_the_norms_are_those_of_the_terms(tmp_path: Path):
    module = net()
    trainer = trainer_of(module, tmp_path, steps=1)
    terms = [(0.7, draw_for(module, 1)), (0.3, draw_for(module, -1))]
    wanted, random = [], np.random.default_rng((0, 0))
    for share, draw in terms:
        module.zero_grad()
        for part, compute in draw(random):
            (share * part * compute()).backward()
        wanted.append(float(torch.cat([value.grad.flatten() for value in module.parameters()]).norm()))
    module.zero_grad()
    trainer.train(1, Mixture(terms), lambda _step, _loss: None)
    ((step, *norms),) = trainer.gradient_norms
    assert step == 1
    assert norms == pytest.approx(wanted, rel=1e-5)


def test_a_term_may_leave_weights_alone(tmp_path: Path):
    """One term trains both layers, the other one the last alone: a weight without a gradient counts as zero."""
    module = net()

    def last(random: np.random.Generator):
        values = torch.from_numpy(random.standard_normal((4, 8)).astype(np.float32))
        yield 1.0, lambda: (module[2](values) ** 2).mean()

    for order in (0, 1):
        terms = [(0.5, draw_for(module, 1)), (0.5, last)]
        trainer = trainer_of(module, tmp_path / str(order), steps=1)
        before = [value.detach().clone() for value in module.parameters()]
        trainer.train(1, Mixture(terms[:: 1 - 2 * order]), lambda _step, _loss: None)
        ((_, first, second),) = trainer.gradient_norms
        assert first > 0
        assert second > 0
        assert all(not torch.equal(old, new) for old, new in zip(before, module.parameters(), strict=True))
