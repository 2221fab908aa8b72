"""Whether the reference does its task: against what does not look, on rows that are built by hand."""

from __future__ import annotations

import math

import pytest

from vlatool.accuracy.credibility import SKILL, VARIATION, credibility, lower_bound
from vlatool.report import Measurement, Row


def share(name: str, value: float, samples: int) -> Measurement:
    return Measurement(name, value, "1", samples=samples)


def skilled(value: float, low: float | None = None, note: str = "") -> Measurement:
    low = value - 0.05 if low is None else low
    return Measurement("skill_expert", value, "1", samples=64, low=low, high=value + 0.05, note=note)


def varied(value: float) -> Measurement:
    return share("variation", value, 64)


ERROR = share("error_expert", 0.3, 64)


def judged(*measurements: Measurement):
    return credibility(Row("float32", "baseline", measurements=measurements), "float32")


@pytest.mark.parametrize(
    ("own", "chance", "verdict"),
    [
        ((0.9, 20), (0.05, 20), "credible"),
        ((1.0, 10), (0.0, 10), "credible"),
        ((0.3, 200), (0.0, 20), "credible"),
        ((0.3, 200), (0.25, 20), "fails"),
        ((1.0, 20), (1.0, 20), "fails"),
        ((0.5, 4), (0.0, 4), "fails"),
        ((0.0, 200), (0.0, 20), "fails"),
    ],
)
def test_success_must_be_above_what_succeeds_without_looking(own, chance, verdict):
    found = judged(share("success", *own), share("success_chance", *chance))
    assert found.verdict == verdict
    assert found.fails == bool(found.sentences)


def test_a_reference_that_never_succeeds_fails_though_nothing_else_was_played():
    found = judged(share("success", 0.0, 20))
    assert found.sentences[0] == (
        "The reference fails, so that nothing can be held against it: float32 succeeds in none of 20 closed-loop "
        "episodes."
    )
    assert "is_success" in found.sentences[1]
    assert "wrapper" in found.sentences[1]


def test_the_sentence_says_both_shares_and_few_episodes_their_remedy():
    found = judged(share("success", 0.5, 20), share("success_chance", 0.5, 20))
    assert "float32 succeeds in 50.0% of 20" in found.sentences[0]
    assert "in 50.0% of 20, which cannot tell them apart" in found.sentences[0]
    assert "--episodes" in found.sentences[1]
    many = judged(share("success", 0.5, 2000), share("success_chance", 0.5, 200))
    assert "--episodes" not in many.sentences[1]


def test_the_bound_of_the_difference_is_that_of_newcombes_example():
    """56/70 against 48/80: 0.2 with 0.0524 to 0.3339 (Newcombe 1998, table II, method 10)."""
    assert lower_bound(share("a", 56 / 70, 70), share("b", 48 / 80, 80)) == pytest.approx(0.0524, abs=5e-5)


@pytest.mark.parametrize(
    ("measurements", "verdict"),
    [
        ((skilled(0.6), varied(0.9), ERROR), "credible"),
        ((skilled(SKILL), varied(VARIATION), ERROR), "credible"),
        ((skilled(SKILL - 0.01), varied(0.9), ERROR), "fails"),
        ((skilled(0.3, low=-0.01), varied(0.9), ERROR), "fails"),
        ((skilled(-0.4), varied(0.9), ERROR), "fails"),
        ((skilled(0.3), varied(VARIATION - 0.01), ERROR), "fails"),
        ((skilled(0.3), varied(0.05)), "credible"),
        ((skilled(math.nan, low=math.nan, note="the expert's action never varies"), varied(0.5)), "fails"),
        ((varied(0.5),), "unknown"),
        ((varied(0.0),), "fails"),
        ((), "unknown"),
    ],
)
def test_on_recordings_the_best_constant_action_is_the_floor(measurements, verdict):
    found = judged(*measurements)
    assert found.verdict == verdict
    assert found.fails == bool(found.sentences)
    if verdict == "unknown":
        assert "unmeasured" in found.warnings[0]


def test_the_floor_is_told():
    (first, *_), (line, *_) = judged(skilled(0.05)).sentences, judged(skilled(0.6)).table
    assert "makes 95.0% of the error of the best constant action on 64 recorded observations" in first
    assert "less than 90%" in first
    assert line["floor"].startswith("0.1")
    assert line["reference"] == 0.6


def test_episodes_decide_where_there_are_some_and_recordings_are_then_a_warning():
    episodes = share("success", 0.9, 50), share("success_chance", 0.0, 20)
    good, bad = judged(*episodes, skilled(0.6)), judged(*episodes, skilled(0.0))
    assert (good.verdict, good.warnings) == ("credible", ())
    assert bad.verdict == "credible"
    assert "100.0% of the error of the best constant action" in bad.warnings[0]
    assert judged(share("success", 0.0, 50), skilled(0.9)).fails


def test_what_was_compared_is_said_of_a_credible_one_too():
    told = judged(share("success", 0.9, 50), share("success_chance", 0.05, 20)).floor
    assert (
        told == "float32 succeeds in 90.0% of 50 episodes; actions that do not look at the observation in 5.0% of 20."
    )
    told = judged(skilled(0.6), varied(0.9), ERROR).floor
    assert told == "float32 makes 40.0% of the error of the best constant action on 64 recorded observations."
    assert judged(varied(0.5)).floor == ""
