from __future__ import annotations

import math

import numpy as np
import pytest
from _examined import all_found
from _examined import found as examined

from vlatool.gate import timing_processes as timed_module
from vlatool.gate.claims.latency import Latency, change, decision_words, slower
from vlatool.measurement.pairs import Pairs
from vlatool.stats.sequential import Decision


@pytest.mark.parametrize(
    ("slowdown", "verdict"), [(0.0, "pass"), (-0.3, "pass"), (0.12, "fail"), (0.5, "fail"), (0.05, "inconclusive")]
)
def test_the_verdict_follows_the_slowdown(timed, slowdown: float, verdict: str) -> None:
    found = examined(Latency(), timed=timed(slowdown))
    assert (found.claim, found.verdict) == ("latency", verdict)
    assert [measured.name for measured in found.measurements] == ["latency_ratio", "latency_mean_ratio"]
    for measured in found.measurements:
        assert measured.low < 1 + slowdown < measured.high
        assert measured.samples == (40 if verdict == "inconclusive" else 10)


def test_a_few_slow_observations_fail_by_the_mean(timed, monkeypatch) -> None:
    """Two of twenty observations take twice as long: the median is that of the baseline."""

    def measured(job, timeout):
        base = 5 * np.exp(0.02 * np.random.default_rng(job.seed).normal(size=60))
        places = [number % 20 for number in range(60)]
        mine = [2 * ms if place < 2 else ms for ms, place in zip(base, places, strict=True)]
        return Pairs(tuple(base), tuple(mine), tuple(places))

    processes = timed()
    monkeypatch.setattr(timed_module, "measure_pairs", measured)
    found = examined(Latency(), timed=processes)
    assert found.verdict == "fail"
    assert found.sentence.startswith("the mean over observations is 7.2% slower")
    assert found.measurements[0].value == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("slow", "verdict"), [(20, "fail"), (19, "fail"), (18, "pass"), (0, "pass")])
def test_one_observation_that_is_slow_each_time_fails(timed, monkeypatch, slow: int, verdict: str) -> None:
    def measured(job, timeout):
        further = (math.log(3),) * slow + (0.0,) * (20 - slow)
        return Pairs((5.0,) * 60, (5.0,) * 60, slow=further if job.seed == 3 else (), slow_input="recorded: 3x")

    processes = timed()
    monkeypatch.setattr(timed_module, "measure_pairs", measured)
    found = examined(Latency(), timed=processes)
    assert found.verdict == verdict
    assert ("1 of 10 processes found an observation that is slower by more than 50% each time: recorded: 3x"
            in found.sentence) == (verdict == "fail")  # fmt: skip
    assert examined(Latency(worst=2.5), timed=processes).verdict == "pass"


@pytest.mark.parametrize(("slow", "verdicts"), [(4, ["pass", "fail"]), (1, ["fail", "pass"])])
def test_each_number_of_threads_is_a_claim_of_its_own(timed, monkeypatch, slow: int, verdicts: list[str]) -> None:
    """As fast as the baseline with one thread, slower with four: and the other way round."""

    def measured(job, timeout):
        base = 5 * np.exp(0.02 * np.random.default_rng(job.seed).normal(size=60))
        return Pairs(tuple(base), tuple(base * (1.3 if job.threads == slow else 1.0)))

    processes = timed()
    monkeypatch.setattr(timed_module, "measure_pairs", measured)
    found = all_found(Latency(also_threads=(4,)), timed=processes)
    assert [each.verdict for each in found] == verdicts
    assert [each.claim for each in found] == ["latency", "latency, 4 threads"]
    assert len({each.name for part in found for each in part.measurements}) == 4


def test_a_process_that_was_measured_is_not_measured_again(timed) -> None:
    processes = timed(0.0)
    examined(Latency(), timed=processes)
    assert len(processes.pairs) == 10
    first = [pairs.log_ratio for pairs in processes.pairs]
    examined(Latency(interim_analyses=(12,)), timed=processes)
    assert [pairs.log_ratio for pairs in processes.pairs][:10] == first
    assert len(processes.pairs) == 12


def test_the_sentence_says_what_was_found_and_what_could_have_been() -> None:
    fine = decision_words(Decision("pass", 0.98, 0.95, 1.01, 0.05, 10, 0.02))
    assert fine.startswith("2.0% faster (-5.0% to +1.0%, 10 processes; allowed: +5.0%); a slowdown of ")
    assert "would decide" not in fine
    open_ = decision_words(Decision("inconclusive", 1.04, 0.0, math.inf, 0.05, 10, 0.02))
    assert "4.0% slower (unbounded to unbounded, 10 processes" in open_
    assert "processes would decide" in open_
    assert (slower(1.0), change(1.1)) == ("0.0% slower", "+10.0%")


def test_where_no_sensible_number_would_decide_the_reason_is_said() -> None:
    noisy = decision_words(Decision("inconclusive", 1.01, 0.2, 3.0, 0.05, 10, 4.0))
    assert noisy.endswith(", this machine is too noisy to decide it: let nothing else run")
    close = decision_words(Decision("inconclusive", 1.05, 1.04, 1.06, 0.05, 10, 0.02))
    assert close.endswith(", it is too close to what is allowed for more processes to decide")
    assert "would decide" not in noisy + close
