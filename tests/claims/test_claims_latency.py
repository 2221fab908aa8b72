from __future__ import annotations

import math

import pytest

from vlatool.claims.latency import change, examine, slower, told
from vlatool.gate import LatencyClaim
from vlatool.regression import Decision


@pytest.mark.parametrize(
    ("slowdown", "verdict"), [(0.0, "pass"), (-0.3, "pass"), (0.12, "fail"), (0.5, "fail"), (0.05, "inconclusive")]
)
def test_the_verdict_follows_the_slowdown(timed, slowdown: float, verdict: str) -> None:
    found = examine(timed(slowdown), LatencyClaim())
    assert (found.claim, found.verdict) == ("latency", verdict)
    (measured,) = found.measurements
    assert measured.name == "latency_ratio"
    assert measured.low < 1 + slowdown < measured.high
    assert measured.samples == (40 if verdict == "inconclusive" else 10)


def test_a_process_that_was_measured_is_not_measured_again(timed) -> None:
    processes = timed(0.0)
    examine(processes, LatencyClaim())
    assert len(processes.pairs) == 10
    first = [pairs.log_ratio for pairs in processes.pairs]
    examine(processes, LatencyClaim(looks=(12,)))
    assert [pairs.log_ratio for pairs in processes.pairs][:10] == first
    assert len(processes.pairs) == 12


def test_the_sentence_says_what_was_found_and_what_could_have_been() -> None:
    fine = told(Decision("pass", 0.98, 0.95, 1.01, 0.05, 10, 0.02))
    assert fine.startswith("2.0% faster (-5.0% to +1.0%, 10 processes; allowed: +5.0%); a slowdown of ")
    assert "would decide" not in fine
    open_ = told(Decision("inconclusive", 1.04, 0.0, math.inf, 0.05, 10, 0.02))
    assert "4.0% slower (unbounded to unbounded, 10 processes" in open_
    assert "processes would decide" in open_
    assert (slower(1.0), change(1.1)) == ("0.0% slower", "+10.0%")
