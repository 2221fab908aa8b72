from __future__ import annotations

import numpy as np
import pytest
from _full import small_or_full

from vlatool.accuracy.losses import LEAST_SCALE, drop, losses, scale_of
from vlatool.bundle.spec import TensorSpec

CONTINUOUS = TensorSpec("action", (1, 2, 2), "float32")
DISCRETE = TensorSpec("action", (1, 10), "int64", kind="discrete", labels=tuple("abcdefghij"))


def test_continuous_losses_by_hand() -> None:
    wanted = np.zeros((2, 2, 2))
    wanted[..., 0] = [[0, 2], [0, 2]]
    got = wanted + np.array([0.5, 7.0])
    still = 7.0 / (LEAST_SCALE * 1.0)
    assert losses(CONTINUOUS, got, wanted) == pytest.approx([(0.5 + still) / 2] * 2), "holding still is a task, too"
    assert losses(CONTINUOUS, np.ones((2, 2, 2)), np.zeros((2, 2, 2))).tolist() == [1, 1], "unless none does"


def test_an_element_is_taken_to_vary_by_a_tenth_of_what_the_largest_of_its_unit_does() -> None:
    action = TensorSpec("action", (1, 1, 4), unit=("m", "m", "rad", "1"))
    wanted = np.zeros((2, 1, 4))
    wanted[:, 0] = [[0, 1e-9, 0, -1], [8, 2e-9, 2e-2, -1]]
    assert scale_of(action, wanted) == pytest.approx([4, 0.4, 1e-2, 0.4]), "the gripper's unit has none that moves"
    assert not scale_of(action, np.ones((3, 1, 4))).any()
    trembling = wanted * np.array([1, 1, 1e-6, 1])
    assert scale_of(action, trembling) == pytest.approx([4, 0.4, 0.4, 0.4]), "a unit that only trembles holds still"
    jitter = wanted + np.array([0, 4e-9, 0, 0])
    assert losses(action, jitter, wanted).max() < 1e-7
    opened = wanted + np.array([0, 0, 0, 2])
    assert losses(action, opened, wanted) == pytest.approx([2 / 0.4 / 4] * 2)


def test_a_longer_chunk_is_compared_as_far_as_both_go() -> None:
    wanted = np.random.default_rng(0).normal(size=(5, 2, 3))
    longer = np.concatenate([wanted, np.full((5, 4, 3), 99.0)], axis=1)
    assert losses(CONTINUOUS, longer, wanted).tolist() == [0] * 5


def test_discrete_losses_are_the_share_that_differs() -> None:
    assert losses(DISCRETE, np.array([1, 2, 3]), np.array([1, 0, 3])).tolist() == [0, 1, 0]
    pairs = losses(DISCRETE, np.array([[1, 2], [3, 4]]), np.array([[1, 9], [3, 4]]))
    assert pairs.tolist() == [0.5, 0]


def test_discrete_chunks_are_compared_as_far_as_both_go() -> None:
    got = np.array([[1, 2, 3, 4], [5, 6, 7, 8]])
    assert losses(DISCRETE, got, np.array([[1], [6]])).tolist() == [0, 1]
    assert losses(DISCRETE, got, np.array([[1, 9], [5, 6]])).tolist() == [0.5, 0]


def test_the_same_losses_are_no_drop() -> None:
    off = np.random.default_rng(1).random(50)
    assert drop(off, off, None, 0.98) == (0, 0, 0)
    assert drop(off, off, np.zeros(50), 0.98) == (0, 0, 0), "of one episode, too: the very same actions"


@pytest.mark.parametrize("episodes", [2, 3, 5, 8, 30])
def test_the_interval_holds_the_drop_however_few_episodes_there_are(episodes: int) -> None:
    """Of 300 at 90 %, 15 on either side are expected to miss; 30 would be a fault. Of 60, 3 are, and 10 would be."""
    draws, fault = small_or_full((60, 10), (300, 30))
    random = np.random.default_rng(2)
    groups = np.repeat(np.arange(episodes), 10)
    missed = [0, 0]
    for seed in range(draws):
        after = 0.1 + np.repeat(0.3 * random.normal(size=episodes), 10) + 0.1 * random.normal(size=len(groups))
        value, low, high = drop(after, np.zeros(len(groups)), groups, 0.9, seed=seed)
        assert low <= value <= high
        missed[0] += low > 0.1
        missed[1] += high < 0.1
    assert max(missed) < fault


def test_one_episode_says_nothing_of_others() -> None:
    value, low, high = drop(np.full(40, 0.2), np.zeros(40), np.zeros(40), 0.98)
    assert (value, low, high) == (pytest.approx(0.2), -np.inf, np.inf)


def test_samples_of_one_episode_are_no_independent_witnesses() -> None:
    random = np.random.default_rng(3)
    episodes = np.repeat(np.arange(6), 50)
    after = np.repeat(random.normal(size=6), 50)
    apart, whole = (drop(after, np.zeros(300), groups, 0.95) for groups in (None, episodes))
    assert whole[2] - whole[1] > 3 * (apart[2] - apart[1])


@pytest.mark.parametrize("lost", [0, 2])
@pytest.mark.parametrize("share", [1.0, 1 / 7])
def test_a_few_wrong_answers_leave_room_for_more(lost: int, share: float) -> None:
    before, after = np.zeros(40), np.zeros(40)
    after[:lost] = share
    value, low, high = drop(after, before, None, 0.98, answers=True)
    assert value == pytest.approx(share * lost / 40)
    assert low < value < high, "no change in forty answers is not none in a thousand"
