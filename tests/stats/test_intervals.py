import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from vlatool.stats.intervals import mcnemar_exact, paired_drop, quantile_interval, student, wilson

Z95 = 1.959963984540054


def binomial(count: int, chance: Fraction) -> list[Fraction]:
    """Exact probabilities of 0..count successes."""
    return [math.comb(count, k) * chance**k * (1 - chance) ** (count - k) for k in range(count + 1)]


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (1, 1), (0, 20), (3, 20), (20, 20), (98, 100), (500, 1000)])
def test_the_bounds_of_wilson_solve_the_score_equation(successes, trials):
    share = successes / trials
    for bound in wilson(successes, trials):
        if 1e-9 < bound < 1 - 1e-9:
            assert abs(share - bound) == pytest.approx(Z95 * math.sqrt(bound * (1 - bound) / trials))
        else:
            assert bound == pytest.approx(share, abs=1e-9)


def test_wilson_contains_the_share_mirrors_and_narrows():
    for successes in range(21):
        low, high = wilson(successes, 20)
        assert 0 <= low <= successes / 20 + 1e-12
        assert successes / 20 - 1e-12 <= high <= 1
        assert wilson(20 - successes, 20) == pytest.approx((1 - high, 1 - low))
    widths = [high - low for low, high in (wilson(9 * n, 10 * n) for n in (1, 10, 100))]
    assert all(wide > narrow for wide, narrow in pairwise(widths))
    narrow, wide = wilson(9, 10, 0.5), wilson(9, 10, 0.99)
    assert wide[0] < narrow[0] < narrow[1] < wide[1]


def test_wilson_covers_what_it_promises_on_average():
    """Exact coverage over a grid of true shares, from the binomial distribution; Wilson's mean is near nominal."""
    trials = 30
    intervals = [wilson(k, trials) for k in range(trials + 1)]
    grid = [Fraction(step, 40) for step in range(2, 39)]
    covered = [
        float(sum(p for p, (low, high) in zip(binomial(trials, share), intervals, strict=True) if low <= share <= high))
        for share in grid
    ]
    assert 0.94 < sum(covered) / len(covered) < 0.97
    assert min(covered) > 0.90


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (2, 1), (-1, 4)])
def test_wilson_refuses_impossible_counts(successes, trials):
    with pytest.raises(ValueError, match="successes in"):
        wilson(successes, trials)


@pytest.mark.parametrize("lost", range(8))
@pytest.mark.parametrize("won", range(8))
def test_mcnemar_is_the_sum_of_the_outcomes_that_are_as_unlikely(lost, won):
    chances = binomial(lost + won, Fraction(1, 2))
    exact = sum(chance for chance in chances if chance <= chances[lost])
    assert mcnemar_exact(lost, won) == pytest.approx(float(exact))
    assert mcnemar_exact(lost, won) == mcnemar_exact(won, lost)


def test_mcnemar_of_no_discordant_pair_is_one():
    assert mcnemar_exact(0, 0) == 1.0


def test_mcnemar_of_many_pairs_does_not_overflow():
    assert mcnemar_exact(3000, 2000) == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize(
    ("lost", "won", "pairs"), [(0, 0, 10), (3, 1, 50), (0, 4, 20), (10, 10, 20), (1, 0, 1), (7, 0, 7)]
)
def test_the_drop_is_within_its_interval_and_changes_sign_with_the_roles(lost, won, pairs):
    drop, low, high = paired_drop(lost, won, pairs)
    assert drop == (lost - won) / pairs
    assert -1 <= low <= drop <= high <= 1
    assert paired_drop(won, lost, pairs) == pytest.approx((-drop, -high, -low))


def test_more_confidence_and_fewer_pairs_widen_the_interval_of_the_drop():
    def width(*arguments):
        _, low, high = paired_drop(*arguments)
        return high - low

    assert width(4, 2, 100, 0.99) > width(4, 2, 100, 0.95) > width(40, 20, 1000, 0.95)


@pytest.mark.parametrize(("lose", "win"), [(0.05, 0.05), (0.10, 0.02), (0.02, 0.01)])
def test_the_interval_of_the_drop_covers_the_truth(lose, win):
    pairs = 150
    draws = np.random.default_rng(0).multinomial(pairs, [lose, win, 1 - lose - win], 2000)
    intervals = [paired_drop(int(lost), int(won), pairs) for lost, won, _ in draws]
    covered = np.mean([low <= lose - win <= high for _, low, high in intervals])
    assert 0.93 < covered < 0.985


def brute_force_interval(samples, quantile: Fraction, tail: Fraction):
    """The narrowest order statistics whose probability to miss the quantile is at most ``tail`` at each side."""
    ordered, count = sorted(samples), len(samples)
    chances = binomial(count, quantile)
    below = [sum(chances[: k + 1], Fraction(0)) for k in range(count + 1)]  # P(at most k samples lie below)
    low_ranks = [k for k in range(1, count + 1) if below[k - 1] <= tail]
    high_ranks = [k for k in range(1, count + 1) if below[k - 1] >= 1 - tail]
    low = ordered[max(low_ranks) - 1] if low_ranks else None
    return low, (ordered[min(high_ranks) - 1] if high_ranks else None)


@pytest.mark.parametrize("count", [1, 2, 5, 6, 10, 59, 100])
@pytest.mark.parametrize("quantile", [Fraction(1, 2), Fraction(9, 10), Fraction(95, 100), Fraction(1, 100)])
def test_the_interval_of_a_quantile_is_that_of_exact_binomial_sums(count, quantile):
    samples = np.random.default_rng(count).permutation(count).astype(float)
    value, low, high = quantile_interval(samples, float(quantile))
    assert (low, high) == brute_force_interval(samples, quantile, Fraction(25, 1000))
    assert value == sorted(samples)[max(math.ceil(quantile * count), 1) - 1]
    assert low is None or low <= value
    assert high is None or value <= high


def test_too_few_samples_have_no_bound():
    assert quantile_interval([3.0], 0.5) == (3.0, None, None)
    assert quantile_interval(range(20), 0.99)[2] is None


def test_the_order_of_the_samples_does_not_matter():
    assert quantile_interval([3, 1, 2, 5, 4, 9, 7], 0.5) == quantile_interval([1, 2, 3, 4, 5, 7, 9], 0.5)


def test_the_interval_of_the_median_covers_the_truth():
    random = np.random.default_rng(0)
    runs = [quantile_interval(random.exponential(size=40), 0.5) for _ in range(500)]
    covered = np.mean([low <= math.log(2) <= high for _, low, high in runs])
    assert 0.94 < covered < 0.985


def test_a_large_count_does_not_underflow():
    samples = np.arange(20_000.0)
    value, low, high = quantile_interval(samples, 0.5)
    assert low is not None
    assert high is not None
    assert value - low == pytest.approx(Z95 * math.sqrt(20_000) / 2, rel=0.05)
    assert high - value == pytest.approx(Z95 * math.sqrt(20_000) / 2, rel=0.05)


def test_no_samples():
    with pytest.raises(ValueError, match="no samples"):
        quantile_interval([], 0.5)


@pytest.mark.parametrize(
    ("share", "freedom", "value"),
    [(0.99, 1, 31.8205), (0.975, 2, 4.3027), (0.99, 7, 2.998), (0.995, 19, 2.8609), (0.975, 1000, 1.9623), (0.5, 3, 0)],
)
def test_students_quantiles_are_those_of_the_tables(share, freedom, value):
    assert student(share, freedom) == pytest.approx(value, rel=2e-5, abs=1e-9)
    assert student(1 - share, freedom) == pytest.approx(-student(share, freedom), rel=1e-9, abs=1e-9)
