from __future__ import annotations

import pytest

from vlatool.gate.claims.answers import examine
from vlatool.gate.config import AnswersClaim
from vlatool.measurement.agreement import Agreement, OutputAgreement
from vlatool.measurement.pairs import Pairs

GOOD = OutputAgreement("other", "action", 0.9, 24)


def followed(*correlations: float, kind: str = "other") -> Agreement:
    each = tuple(OutputAgreement(kind, f"out{place}", value, 24) for place, value in enumerate(correlations))
    return Agreement(each, looked=24)


@pytest.mark.parametrize(("least", "verdict"), [(0.99, "pass"), (0.5, "pass"), (0.49, "fail"), (-1.0, "fail")])
def test_the_output_that_follows_least_decides(timed, least: float, verdict: str) -> None:
    found = examine(followed(0.995, least), timed(), AnswersClaim())
    assert (found.claim, found.verdict) == ("answers", verdict)
    assert f"its out1 follows the baseline's with a correlation of {least:.2f}" in found.sentence
    assert found.measurements[0].value == least


def test_a_policy_that_was_trained_anew_need_not_follow(timed) -> None:
    assert examine(followed(-1.0), timed(), AnswersClaim(follows=None)).verdict == "pass"


def test_what_was_drawn_without_a_recording_decides_only_when_there_is_nothing_else(timed) -> None:
    drawn = OutputAgreement("drawn", "action", 0.1, 24)
    assert examine(Agreement((GOOD, drawn), looked=24), timed(), AnswersClaim()).verdict == "pass"
    assert examine(Agreement((drawn,), looked=24), timed(), AnswersClaim()).verdict == "fail"


def test_without_an_answer_of_the_baseline_nothing_is_decided(timed) -> None:
    assert examine(Agreement(), timed(), AnswersClaim()).verdict == "inconclusive"


def test_other_answers_under_time_fail(timed) -> None:
    processes = timed()
    processes.pairs.append(Pairs((1.0,), (1.0,), looked=20, strays=3))
    found = examine(Agreement((GOOD,), looked=24), processes, AnswersClaim())
    assert found.verdict == "fail"
    assert found.sentence.startswith("3 of 44 answers to the same observations differ when they are asked for again")


def test_a_baseline_that_draws_numbers_itself_leaves_it_open(timed) -> None:
    processes = timed()
    processes.pairs.append(Pairs((1.0,), (1.0,), looked=20, strays=3, unsteady=3))
    assert examine(Agreement((GOOD,), looked=24), processes, AnswersClaim()).verdict == "inconclusive"


def test_kept_answers_fail_without_a_process_that_times(timed) -> None:
    assert examine(Agreement((GOOD,), looked=24, strays=1), timed(), AnswersClaim()).verdict == "fail"
