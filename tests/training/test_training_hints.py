"""Distances of what blocks give, against their formulas."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from vlatool import registry
from vlatool.training.hints.attention import Attention
from vlatool.training.hints.features import Features

RANDOM = torch.Generator().manual_seed(0)
STUDENT, TEACHER = (torch.randn(2, 5, 6, generator=RANDOM) * size + 1 for size in (3.0, 0.5))
NARROW = torch.randn(2, 5, 3, generator=RANDOM)


def normal(values: torch.Tensor) -> np.ndarray:
    array = values.numpy().astype(np.float64)
    return (array - array.mean(-1, keepdims=True)) / np.sqrt(array.var(-1, keepdims=True) + 1e-5)


def relations(values: torch.Tensor) -> np.ndarray:
    rows = normal(values)
    scores = np.exp(rows @ rows.swapaxes(1, 2) / rows.shape[-1] * 8)
    return scores / scores.sum(-1, keepdims=True)


def test_features_are_compared_as_normalised():
    wanted = ((normal(STUDENT) - normal(TEACHER)) ** 2).mean()
    assert float(Features()(STUDENT, TEACHER)) == pytest.approx(wanted, rel=1e-5)
    assert float(Features()(7 * TEACHER + 2, TEACHER)) == pytest.approx(0.0, abs=1e-4), "size and offset do not count"
    assert float(Features()(-TEACHER, TEACHER)) == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize("student", [STUDENT, NARROW], ids=["as wide", "narrower"])
def test_relations_are_compared_by_their_divergence(student: torch.Tensor):
    ours, theirs = relations(student), relations(TEACHER)
    wanted = (theirs * np.log(theirs / ours)).sum(-1).mean()
    assert wanted > 0.01
    assert float(Attention()(student, TEACHER)) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("name", registry.names("hints"))
def test_every_distance_is_zero_for_the_teacher_pulls_towards_it_and_is_a_mean_over_rows(name: str):
    hint = registry.load("hints", name)()
    assert float(hint(TEACHER, TEACHER)) == pytest.approx(0.0, abs=1e-6)
    student = STUDENT.clone().requires_grad_()
    (slope,) = torch.autograd.grad(hint(student, TEACHER), student)
    assert float(hint((student - 0.1 * slope).detach(), TEACHER)) < float(hint(STUDENT, TEACHER))
    rows = [float(hint(STUDENT[row : row + 1], TEACHER[row : row + 1])) for row in range(2)]
    assert float(hint(STUDENT, TEACHER)) == pytest.approx(np.mean(rows), rel=1e-5)


@pytest.mark.parametrize(("shape", "channels_first", "says"), [
    ((1, 16, 4, 4), False, r"they give \[1, 16, 4, 4\] for one observation"),
    ((1, 8, 5), True, "where tokens are"),
    ((7, 1, 16), False, "where tokens are"),
    ((1, 16), False, "where tokens are"),
    ((1, 1, 16), False, "a single token"),
])  # fmt: skip
def test_what_has_no_tokens_is_told(shape: tuple[int, ...], channels_first: bool, says: str):
    assert re.search(says, Attention().why_not(shape, channels_first))
    assert Features().why_not(shape, channels_first) == ""
    assert Attention().why_not((1, 2, 16), False) == ""
    assert Features().why_not((1,), False)
