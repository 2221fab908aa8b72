from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from vlatool.stats.signed_rank import _rank, hodges_lehmann, lower_bound, min_differences, upper_bound, walsh


def test_the_walsh_averages_by_hand() -> None:
    assert walsh([3.0, 1.0]).tolist() == [1, 2, 3]
    assert hodges_lehmann([3.0, 1.0, 20.0]) == pytest.approx(np.median([1, 2, 3, 10.5, 11.5, 20]))


@pytest.mark.parametrize("count", range(1, 13))
@pytest.mark.parametrize("alpha", [0.2, 0.05, 0.01])
def test_the_rank_is_that_of_all_sign_patterns(count: int, alpha: float) -> None:
    sums = [
        sum(rank for rank, sign in enumerate(signs, 1) if sign) for signs in itertools.product((0, 1), repeat=count)
    ]
    most = max(each for each in range(-1, max(sums)) if sum(found <= each for found in sums) <= alpha * 2**count)
    assert _rank(count, alpha) == most + 1


def test_the_ranks_of_the_gate() -> None:
    """Computed independently: n = 10, 20, 40 at a third of one percent."""
    assert [_rank(count, 0.01 / 3) for count in (10, 20, 40)] == [3, 35, 212]


@pytest.mark.parametrize("draw", ["normal", "laplace", "uniform"])
def test_the_bounds_hold_with_the_stated_chance(draw: str) -> None:
    random = np.random.default_rng(0)
    outside = [0, 0]
    for _ in range(2000):
        values = getattr(random, draw)(size=10) - (0.5 if draw == "uniform" else 0)
        outside[0] += lower_bound(values, 0.05) > 0
        outside[1] += upper_bound(values, 0.05) < 0
    assert all(50 <= count <= 130 for count in outside), "5 % of 2,000 are 100; the exact level is 4.2 %"


def test_the_bounds_mirror_each_other() -> None:
    values = np.random.default_rng(1).normal(size=15)
    assert upper_bound(values, 0.01) == -lower_bound(-values, 0.01)
    assert lower_bound(values, 0.01) <= lower_bound(values, 0.1) <= hodges_lehmann(values) <= upper_bound(values, 0.1)


@pytest.mark.parametrize(("alpha", "count"), [(0.5, 1), (0.25, 2), (0.01, 7), (0.01 / 3, 9)])
def test_too_few_pairs_have_no_bound(alpha: float, count: int) -> None:
    assert min_differences(alpha) == count
    assert math.isfinite(lower_bound(np.ones(count), alpha))
    assert lower_bound(np.ones(count - 1), alpha) == -math.inf if count > 1 else True


@pytest.mark.parametrize("alpha", [0, 1, -0.1])
def test_an_impossible_error_is_refused(alpha: float) -> None:
    with pytest.raises(ValueError, match="alpha is"):
        min_differences(alpha)


@pytest.mark.parametrize("values", [[], [1.0, math.inf], [math.nan]])
def test_nothing_and_not_a_number_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="no difference"):
        walsh(values)
