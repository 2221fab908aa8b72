"""Skill against the best constant action, and how much actions vary."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vlatool.accuracy.skill import best_constant, skill, variation
from vlatool.bundle.spec import TensorSpec

MOVE = TensorSpec("action", (1, 2, 2), labels=("dx", "dy"), unit="m")
TURN = TensorSpec("action", (1, 3), kind="discrete", labels=("left", "right", "forward"))
EXPERT = np.random.default_rng(0).normal(size=(200, 2, 2))
LABELS = np.random.default_rng(1).choice(3, p=[0.5, 0.3, 0.2], size=(200, 1))


def value(action: TensorSpec, got: np.ndarray, expert: np.ndarray) -> float:
    return skill(action, got, expert).value


def test_the_expert_has_all_skill_and_the_constant_none() -> None:
    assert value(MOVE, EXPERT, EXPERT) == 1.0
    assert value(MOVE, best_constant(MOVE, EXPERT), EXPERT) == 0.0
    assert value(TURN, LABELS, LABELS) == 1.0
    assert value(TURN, np.zeros_like(LABELS), LABELS) == pytest.approx(0.0)


def test_no_other_constant_is_better() -> None:
    for constant in (0.0, 0.3, -1.0):
        assert value(MOVE, np.full_like(EXPERT, constant), EXPERT) <= 0.0
    assert value(TURN, np.full_like(LABELS, 2), LABELS) < 0.0


def test_a_longer_expert_and_a_shorter_policy_are_compared_as_far_as_both_go() -> None:
    longer = np.concatenate([EXPERT, np.full((200, 3, 2), 99.0)], axis=1)
    assert value(MOVE, 0.5 * EXPERT, longer) == pytest.approx(value(MOVE, 0.5 * EXPERT, EXPERT))


@pytest.mark.parametrize("factor", [0.02, 57.3, -1.0])
def test_a_wrong_unit_or_sign_has_none_to_speak_of(factor: float) -> None:
    assert value(MOVE, factor * EXPERT, EXPERT) < 0.1


def test_shuffled_actions_have_none_with_confidence() -> None:
    for action, expert in ((MOVE, EXPERT), (TURN, LABELS)):
        found = skill(action, np.random.default_rng(2).permutation(expert), expert)
        assert found.low < 0


def test_the_interval_holds_the_value_and_few_samples_say_little() -> None:
    got = EXPERT + 0.5 * np.random.default_rng(3).normal(size=EXPERT.shape)
    many, few = skill(MOVE, got, EXPERT), skill(MOVE, got[:4], EXPERT[:4])
    assert 0 < many.low < many.value < many.high
    assert few.high - few.low > many.high - many.low
    whole = skill(MOVE, got, EXPERT, np.arange(200) // 10)
    assert whole.low < whole.value < whole.high


@pytest.mark.parametrize("expert", [np.full((9, 2, 2), 0.3), np.full((9, 1), 1)])
def test_an_expert_that_never_varies_has_no_skill_to_measure(expert: np.ndarray) -> None:
    found = skill(MOVE if expert.ndim == 3 else TURN, expert * 1, expert)
    assert math.isnan(found.value)
    assert "never varies" in found.note


def test_variation_is_by_the_experts() -> None:
    (found,) = variation(MOVE, 0.25 * EXPERT, EXPERT)
    assert found.value == pytest.approx(0.25)
    (still,) = variation(MOVE, EXPERT * 0 + 0.7, EXPERT)
    assert still.value == 0.0
    (alone,) = variation(MOVE, EXPERT * 0 + 0.7, None)
    assert alone.value == 0.0
    (moving,) = variation(MOVE, EXPERT, None)
    assert moving.value > 0.1


def test_variation_of_answers_is_the_share_of_the_others() -> None:
    (found,) = variation(TURN, np.array([[0]] * 6 + [[1]] * 2), None)
    assert found.value == pytest.approx(0.25)
    assert variation(TURN, np.array([[0]] * 7), None) == []
