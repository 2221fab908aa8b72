from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from vlatool.stats.sequential import INTERIM_ANALYSES, Decision, judge, judge_jointly

Source = Callable[[int], float]


def noisy(shift: float, seed: int, spread: float = 0.022) -> Source:
    random = np.random.default_rng(seed)
    return lambda number: shift + spread * random.standard_t(4) / math.sqrt(2)


def sequential(
    measure: Source, margin: float, interim_analyses: Sequence[int] = INTERIM_ANALYSES
) -> tuple[Decision, list[float]]:
    """One statistic alone: its decision, and the log ratio of every process."""
    decisions, processes = judge_jointly(lambda number: (measure(number),), 1, margin, interim_analyses)
    return decisions[0], [ratios[0] for ratios in processes]


def verdicts(shift: float, margin: float = 0.05, runs: int = 200) -> dict[str, int]:
    found = [sequential(noisy(shift, seed), margin)[0].verdict for seed in range(runs)]
    return {verdict: found.count(verdict) for verdict in ("pass", "fail", "inconclusive")}


def test_the_same_thing_twice_passes() -> None:
    found = verdicts(0.0)
    assert found["fail"] == 0
    assert found["inconclusive"] <= 2


def test_a_slowdown_beyond_the_margin_fails() -> None:
    assert verdicts(math.log(1.10))["fail"] >= 198
    assert verdicts(math.log(1.20)) == {"pass": 0, "fail": 200, "inconclusive": 0}


def test_on_the_margin_hardly_anything_is_decided() -> None:
    found = verdicts(math.log(1.05))
    assert found["fail"] <= 6, "1 % of 200, and some luck"
    assert found["pass"] <= 6
    assert found["inconclusive"] >= 190


def test_no_more_processes_are_measured_than_needed() -> None:
    decision, ratios = sequential(noisy(0.0, 1), 0.05)
    assert decision.processes == len(ratios) == INTERIM_ANALYSES[0]
    decision, ratios = sequential(noisy(math.log(1.05), 2), 0.05)
    assert decision.processes == len(ratios) == INTERIM_ANALYSES[-1]


def test_a_decision_by_hand() -> None:
    ratios = [0.01 * number for number in range(1, 11)]
    found = judge(ratios, 0.05)
    averages = sorted((ratios[i] + ratios[j]) / 2 for i in range(10) for j in range(i, 10))
    assert found.low == pytest.approx(math.exp(averages[2]))
    assert found.high == pytest.approx(math.exp(averages[-3]))
    assert found.ratio == pytest.approx(math.exp(0.055))
    assert found.spread == pytest.approx(np.std(ratios, ddof=1))
    assert found.verdict == "inconclusive"
    assert judge(ratios, 0.2).verdict == "pass"
    assert judge(ratios, 0.005).verdict == "fail"


def test_the_same_ratio_every_time_is_decided_exactly() -> None:
    same = judge([math.log(1.02)] * 10, 0.05)
    assert (same.verdict, same.spread) == ("pass", 0)
    assert same.detectable == pytest.approx(0.05)
    assert same.processes_needed == 0


@pytest.mark.parametrize("processes", [10, 20])
def test_what_it_could_have_found_is_found_95_times_in_100(processes: int) -> None:
    random = np.random.default_rng(5)
    slowdown = Decision("pass", 1.0, 0.98, 1.02, 0.05, processes, 0.01).detectable
    runs = [math.log1p(slowdown) + 0.01 * random.normal(size=processes) for _ in range(400)]
    assert 368 < sum(judge(run, 0.05).verdict == "fail" for run in runs) < 394


def test_what_could_be_found_narrows_with_processes_and_widens_with_the_spread() -> None:
    wide, narrow = (Decision("pass", 1.0, 0.98, 1.02, 0.05, 10, spread) for spread in (0.05, 0.01))
    more = Decision("pass", 1.0, 0.98, 1.02, 0.05, 40, 0.05)
    assert 0.05 < narrow.detectable < more.detectable < wide.detectable


def test_it_says_how_many_processes_would_decide() -> None:
    near, far = (Decision("inconclusive", ratio, 0.9, 1.2, 0.05, 40, 0.03) for ratio in (1.045, 1.02))
    assert near.processes_needed > far.processes_needed > 40
    assert Decision("inconclusive", 1.05, 0.9, 1.2, 0.05, 40, 0.03).processes_needed == 1_000_000
    assert Decision("fail", 1.2, 1.1, 1.3, 0.05, 40, 0.03).processes_needed == 0


@pytest.mark.parametrize("interim_analyses", [(), (5,), (20, 10), (10, 10), (8, 20, 40)])
def test_interim_analyses_that_decide_nothing_are_refused(interim_analyses: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="allowed: ascending numbers from"):
        sequential(noisy(0, 0), 0.05, interim_analyses)


@pytest.mark.parametrize("margin", [-1, -2, math.nan])
def test_a_margin_that_is_none_is_refused(margin: float) -> None:
    with pytest.raises(ValueError, match="the margin is"):
        judge([0.0] * 10, margin)


def test_one_statistic_that_fails_ends_it_and_all_must_pass() -> None:
    slower, same = noisy(0.3, 1), noisy(0.0, 2)
    decisions, found = judge_jointly(lambda number: (same(number), slower(number)), 2, 0.05)
    assert [decision.verdict for decision in decisions] == ["pass", "fail"]
    assert len(found) == 10
    decisions, _ = judge_jointly(lambda number: (same(number), same(number)), 2, 0.05)
    assert {decision.verdict for decision in decisions} == {"pass"}
    at = noisy(math.log(1.05), 5)
    open_, _ = judge_jointly(lambda number: (at(number), same(number)), 2, 0.05)
    assert open_[0].verdict == "inconclusive"


def test_statistics_share_the_error_of_a_failure_alone() -> None:
    alone, shared = (judge([0.01 * number for number in range(10)], 0.05, sharing=sharing) for sharing in (1, 2))
    assert shared.low < alone.low
    assert (shared.high, shared.ratio) == (alone.high, alone.ratio)
    with pytest.raises(ValueError, match="ascending numbers from 10"):
        judge_jointly(lambda _: (0.0, 0.0), 2, 0.05, (9, 20, 40))


@pytest.mark.parametrize("tail", ["normal", "stalls"])
def test_equal_bundles_fail_in_fewer_than_one_in_a_hundred_gates(tail: str) -> None:
    """Median and mean of equal bundles, correlated as they are, in 300 gates."""
    random = np.random.default_rng(3)

    def measure(_: int) -> tuple[float, float]:
        one, two = random.normal(size=2) * 0.05
        if tail == "stalls" and random.random() < 0.2:
            two += random.choice([-1, 1]) * random.exponential(0.5)
        return float(one), float(0.8 * one + 0.6 * two)

    verdicts = [{each.verdict for each in judge_jointly(measure, 2, 0.05)[0]} for _ in range(300)]
    assert sum("fail" in each for each in verdicts) <= 3
