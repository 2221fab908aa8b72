"""Episodes that begin alike count as hardly more than one."""

from __future__ import annotations

import numpy as np
import pytest

from vlatool.stats.intervals import sign_test, wilson
from vlatool.stats.starts import distinct_starts, has_too_few_starts, independent_starts, reduce_counts, wilson_of
from vlatool.stats.success_sequential import exact_drop, plan


@pytest.mark.parametrize(
    ("starts", "number", "size", "few"),
    [
        (range(300), 300, 300, False),
        ([0, 1, 2] * 100, 3, 3, True),
        ([0] * 200 + list(range(1, 101)), 101, 2, False),
        ([0] * 12, 1, 1, True),
        (range(4), 4, 4, False),
        ([0, 0, 1, 2, 3, 4, 5, 6, 7], 8, 7, False),
    ],
)
def test_episodes_count_by_how_often_their_start_occurs(starts, number: int, size: int, few: bool) -> None:
    assert (distinct_starts(starts), independent_starts(starts), has_too_few_starts(starts)) == (number, size, few)


def test_intervals_are_those_of_the_independent_episodes() -> None:
    assert wilson_of(200, [0, 1, 2] * 100) == wilson(2, 3)
    assert wilson_of(270, range(300)) == wilson(270, 300)
    low, high = wilson_of(150, [0, 1, 2] * 100)
    assert (low, high) == (wilson(1, 3)[0], wilson(2, 3)[1]), "half of an episode counts on both sides"
    assert exact_drop(0, 0, 300, size=3)[1:] == exact_drop(0, 0, 3)[1:]
    assert exact_drop(4, 2, 300, size=300) == exact_drop(4, 2, 300)


def test_what_is_left_of_an_episode_favours_no_side() -> None:
    least, largest = reduce_counts(10, 10, 300, 3)
    assert (least, largest) == ((0, 1, 3), (1, 0, 3))
    assert all(sum(counts[:2]) <= 3 for counts in reduce_counts(200, 100, 300, 2))


def test_repeated_pairs_fail_no_more_often_than_they_may() -> None:
    """Between equal policies, of which a tenth of 40 starts turn out otherwise, 10 episodes of each."""
    random = np.random.default_rng(0)
    starts = np.arange(400) % 40
    wrong = naive = 0
    for _ in range(60):
        outcome = random.choice([-1, 0, 1], size=40, p=[0.05, 0.9, 0.05])[starts]
        lost, won = int((outcome > 0).sum()), int((outcome < 0).sum())
        wrong += exact_drop(lost, won, 400, size=independent_starts(starts.tolist()))[1] > 0
        naive += exact_drop(lost, won, 400)[1] > 0
    assert wrong <= 4, "2.5 % of 60, and chance"
    assert naive > 12, "the interval of as many independent episodes"


def test_a_plan_judges_by_the_size() -> None:
    comparison = plan(0.03, 300, analyses=1)
    assert comparison.judge(0, 0, 300).verdict == "pass"
    assert comparison.judge(0, 0, 300, 3).verdict == "inconclusive"
    assert comparison.judge(60, 0, 300).verdict == "fail"
    assert comparison.judge(60, 0, 300, 3).verdict == "inconclusive"
    assert comparison.judge(60, 0, 300, 100).verdict == "fail"


def test_the_sign_test_is_that_of_coins() -> None:
    assert [sign_test(many, 4) for many in range(5)] == [1.0, 15 / 16, 11 / 16, 5 / 16, 1 / 16]
