"""The interval of a ratio covers the truth as often as it says, and honest comparisons are not called different."""

from __future__ import annotations

import numpy as np
import pytest
from _full import small_or_full

from vlatool.motion.measure import MIN_PAIRS, ratio_of


def pairs(seed: int, count: int, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of paths as tasks have them: skewed, and alike within a pair."""
    random = np.random.default_rng((seed, 3))
    scene = random.lognormal(0.0, 0.5, count)
    return factor * scene * random.lognormal(0.0, 0.1, count), scene * random.lognormal(0.0, 0.1, count)


def test_the_interval_covers_the_ratio():
    draws, least = small_or_full((100, 0.89), (400, 0.92))
    covered = sum(low <= 1.1 <= high for seed in range(draws) for _, low, high in [ratio_of(*pairs(seed, 150, 1.1))])
    assert least <= covered / draws <= 0.98


def test_comparisons_of_a_policy_with_itself_raise_few_alarms():
    draws, most = small_or_full((50, 4), (200, 11))
    alarms = sum(low > 1.0 for seed in range(draws) for _, low, _ in [ratio_of(*pairs(1000 + seed, 200))])
    assert alarms <= most, "2.5 % on one side: 1.25 of 50 and 5 of 200 expected, 4 and 11 at most with a chance of 99 %"


def test_a_higher_confidence_gives_a_wider_interval_and_the_same_data_the_same():
    own, base = pairs(1, 100)
    _, low, high = ratio_of(own, base)
    assert (low, high) == ratio_of(own, base)[1:]
    wide = ratio_of(own, base, 0.999)
    assert wide[1] < low < high < wide[2]


def test_equal_episodes_have_a_ratio_of_exactly_one():
    own, _ = pairs(2, 60)
    assert ratio_of(own, own) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(("own", "base", "wanted"), [
    ([], [], None), ([0.0, 0.0], [0.0, 0.0], (1.0, 1.0, 1.0)), ([1.0, 0.0], [0.0, 0.0], None),
    ([2.0] * (MIN_PAIRS - 1), [1.0] * (MIN_PAIRS - 1), (2.0, 0.0, float("inf"))),
])  # fmt: skip
def test_few_pairs_and_none(own: list[float], base: list[float], wanted: tuple[float, float, float] | None):
    assert ratio_of(np.array(own), np.array(base)) == wanted
