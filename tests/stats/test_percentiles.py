from __future__ import annotations

import math
from fractions import Fraction
from statistics import NormalDist

import numpy as np
import pytest

from vlatool.stats.percentiles import (
    effective_calls,
    effective_sample_size,
    floor,
    intraclass,
    mean_ranks,
    percentile,
    proven_above,
    required_exceedances,
)


def autoregressive(random: np.random.Generator, count: int, follow: float) -> np.ndarray:
    found = np.empty(count)
    value = random.normal()
    for place, shock in enumerate(random.normal(size=count) * math.sqrt(1 - follow**2)):
        value = found[place] = follow * value + shock
    return found


@pytest.mark.parametrize(("percent", "calls"), [(90, 64), (95, 130), (99, 662), (99.9, 6636)])
def test_the_floors_are_those_of_loadgen(percent: float, calls: int) -> None:
    assert floor(percent / 100) == calls
    assert percentile(np.ones(calls), percent).known
    assert not percentile(np.ones(calls - 1), percent).known


@pytest.mark.parametrize("count", [1, 20, 64, 127, 500])
@pytest.mark.parametrize("share", [0.5, 0.9, 0.99])
def test_how_many_may_exceed_follows_from_the_exact_binomial(count: int, share: float) -> None:
    chance = 1 - Fraction(str(share))
    tail, most = Fraction(0), -1
    for exceed in range(count + 1):
        tail += math.comb(count, exceed) * chance**exceed * (1 - chance) ** (count - exceed)
        if tail > Fraction("0.01"):
            break
        most = exceed
    assert required_exceedances(count, share) == most


def test_a_percentile_by_hand() -> None:
    calls = np.random.default_rng(1).permutation(np.arange(1.0, 1308.0))
    found = percentile(calls, 99)
    assert (found.name, found.value) == ("p99", math.ceil(0.99 * 1307))
    assert found.bound == 1302, "five of 1307 may exceed it"
    assert found.effective_sample_size == 1307


def lognormal(random: np.random.Generator) -> np.ndarray:
    return np.exp(0.3 * random.normal(size=800))


def pareto(random: np.random.Generator) -> np.ndarray:
    return 1 + random.pareto(1.5, size=800)


def steps(random: np.random.Generator) -> np.ndarray:
    return np.where(random.random(800) < 0.93, 1.0, 3.0) + 0.01 * random.random(800)


def following(random: np.random.Generator) -> np.ndarray:
    return np.exp(0.3 * autoregressive(random, 800, 0.7))


@pytest.mark.parametrize(
    ("make", "truth"),
    [
        (lognormal, math.exp(0.3 * NormalDist().inv_cdf(0.9))),
        (pareto, 0.1 ** (-1 / 1.5)),
        (steps, 1.0 + 0.01 * 0.9 / 0.93),
        (following, math.exp(0.3 * NormalDist().inv_cdf(0.9))),
    ],
)
def test_the_bound_holds_whatever_the_shape(make, truth: float) -> None:
    """Of 400 runs at 99 %, 4 are expected to miss; 12 would be a fault with a chance of one in a thousand."""
    random = np.random.default_rng(2)
    missed = sum(percentile(make(random), 90).bound < truth for _ in range(400))
    assert missed < 12


def test_calls_that_follow_each_other_are_worth_less() -> None:
    random = np.random.default_rng(3)
    assert effective_calls(random.normal(size=4000)) == pytest.approx(4000, rel=0.06)
    assert effective_calls(autoregressive(random, 4000, 0.7)) == pytest.approx(4000 * 0.3 / 1.7, rel=0.15)
    assert effective_calls(np.ones(50)) == 50
    assert effective_calls(np.tile([1.0, 2.0], 50)) == 100, "turns are no less than independent"
    assert effective_calls(np.array([1.0, 2.0])) == 2


def test_one_long_stall_does_not_hide_that_calls_follow_each_other() -> None:
    series = autoregressive(np.random.default_rng(4), 2000, 0.7)
    stalled = series.copy()
    stalled[1000] = 1e6
    assert effective_calls(stalled) == pytest.approx(effective_calls(series), rel=0.05)


def test_equal_calls_share_a_rank() -> None:
    coarse = np.round(autoregressive(np.random.default_rng(5), 2000, 0.7), 1)
    np.testing.assert_array_equal(mean_ranks(coarse), midranks(coarse))
    follow = np.corrcoef(*(ranks := midranks(coarse), np.roll(ranks, -1)))[0, 1]
    assert effective_calls(coarse) == pytest.approx(2000 * (1 - follow) / (1 + follow), rel=0.01)


def midranks(series: np.ndarray) -> np.ndarray:
    """Each value's rank from 1, as it is defined: how many are below it, and half of its equals."""
    return (series[:, None] > series).sum(1) + ((series[:, None] == series).sum(1) + 1) / 2


def test_a_stall_in_a_thousand_calls_shows() -> None:
    calls = np.random.default_rng(5).normal(5, 0.1, 20_000)
    calls[::500] = 50.0
    assert percentile(calls, 99.9).value == 50.0
    assert percentile(calls, 99).value < 6


@pytest.mark.parametrize(
    ("over", "percent", "proven"), [(0, 99, False), (1, 99, False), (30, 99, True), (30, 90, False)]
)
def test_a_percentile_is_above_when_too_many_calls_are(over: int, percent: float, proven: bool) -> None:
    calls = np.random.default_rng(6).permutation(np.append(np.full(over, 9.0), np.ones(1000 - over)))
    assert proven_above(calls, percent, 5.0) is proven


@pytest.mark.parametrize(("calls", "percent"), [([], 50), ([1.0, math.nan], 50), ([1.0], 0), ([1.0], 100), ([1.0], -5)])
def test_nonsense_is_refused(calls: list[float], percent: float) -> None:
    with pytest.raises(ValueError, match=r"sample|percentage"):
        percentile(calls, percent)


def several(random: np.random.Generator, processes: int, between: float) -> tuple[np.ndarray, list[int]]:
    """Calls of processes that are faster or slower altogether, and the process of each."""
    shifts = np.repeat(between * random.normal(size=processes), 150)
    return np.exp(shifts + 0.05 * random.normal(size=len(shifts))), np.repeat(np.arange(processes), 150).tolist()


@pytest.mark.parametrize("between", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("percent", [50, 90])
def test_the_bound_holds_where_processes_differ(between: float, percent: float) -> None:
    """Of 300 runs 3 are expected to miss, and up to 9 as the effect of 20 processes is estimated; 18 are a fault."""
    random = np.random.default_rng(7)
    truth = math.exp(math.hypot(between, 0.05) * NormalDist().inv_cdf(percent / 100))
    found = [several(random, 20, between) for _ in range(300)]
    known = [each for calls, places in found if (each := percentile(calls, percent, processes=places)).known]
    assert len(known) > 200 or between == 0.05, "calls of processes that differ much are worth little"
    assert sum(each.bound < truth for each in known) < 18
    assert sum(proven_above(calls, percent, truth, processes=places) for calls, places in found) < 18


def test_calls_of_one_process_are_alike_where_processes_differ() -> None:
    random = np.random.default_rng(8)
    alike, places = several(random, 20, 0.0)
    assert effective_sample_size(alike, 0.9, places) == pytest.approx(3000, rel=0.35)
    apart, places = several(random, 20, 0.2)
    assert effective_sample_size(apart, 0.5, places) < 60
    assert effective_sample_size(apart, 0.5, None) > effective_sample_size(apart, 0.5, places)
    assert intraclass(np.array([1.0, 1.0, 5.0, 5.0]), [0, 0, 1, 1]) == 1.0
    assert intraclass(np.ones(4), [0, 0, 1, 1]) == 0.0
    assert intraclass(np.array([1.0, 5.0, 1.0, 5.0]), [0, 0, 1, 1]) < 0
