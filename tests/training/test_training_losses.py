"""Losses against their formulas."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vlatool import registry
from vlatool.training.losses.huber import Huber
from vlatool.training.losses.kl import Kl
from vlatool.training.losses.l1 import L1
from vlatool.training.losses.l2 import L2

RANDOM = torch.Generator().manual_seed(0)
STUDENT, TEACHER = torch.randn(5, 4, generator=RANDOM), torch.randn(5, 4, generator=RANDOM)


def test_kl_is_the_divergence_of_softened_labels():
    ours, theirs = (np.exp(each.numpy() / 3) / np.exp(each.numpy() / 3).sum(1, keepdims=True)
                    for each in (STUDENT, TEACHER))  # fmt: skip
    wanted = 9 * (theirs * np.log(theirs / ours)).sum(1).mean()
    assert float(Kl(3.0)(STUDENT, TEACHER)) == pytest.approx(wanted, rel=1e-5)


def test_errors_of_chunks():
    difference = (STUDENT - TEACHER).numpy()
    assert float(L1()(STUDENT, TEACHER)) == pytest.approx(np.abs(difference).mean(), rel=1e-6)
    assert float(L2()(STUDENT, TEACHER)) == pytest.approx((difference**2).mean(), rel=1e-6)
    near = np.abs(difference) < 0.5
    wanted = np.where(near, 0.5 * difference**2, 0.5 * (np.abs(difference) - 0.25))
    assert float(Huber(0.5)(STUDENT, TEACHER)) == pytest.approx(wanted.mean(), rel=1e-6)


@pytest.mark.parametrize("name", registry.names("losses"))
def test_every_loss_is_zero_for_the_teacher_and_pulls_towards_it(name: str):
    loss = registry.load("losses", name)()
    assert float(loss(TEACHER, TEACHER)) == pytest.approx(0.0, abs=1e-6)
    student = STUDENT.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(student, TEACHER), student)
    assert float(loss((student - 0.01 * slope).detach(), TEACHER)) < float(loss(STUDENT, TEACHER))
