"""A fast wrong answer, and a fast remembered one, are no inference."""

import math

import numpy as np
import pytest
from _policies import Garbage, Memoising

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import observations_for
from vlatool.measurement.answers import AnswerCheck, Answers, expected_answers, measure_caching, vary_observation
from vlatool.runtime.policy import Policy


@pytest.fixture
def policy(float_bundle):
    return Policy.open(float_bundle, threads=1, seed=0)


@pytest.fixture
def observations(float_bundle):
    return observations_for(float_bundle, 8)


def run(policy, observations, answers, rounds=3):
    for _ in range(rounds):
        policy.reset()
        for place, observation in enumerate(observations):
            answers.look(place, policy.infer(observation).outputs)


def test_the_same_answers_are_no_strays(policy, observations):
    answers = expected_answers(policy, observations)
    run(policy, observations, answers)
    assert answers.check() == AnswerCheck(looked=24, strays=0, worst=0.0, first=-1)


def test_a_policy_that_returns_garbage_later_is_seen_from_its_first_stray(policy, observations):
    answers = expected_answers(policy, observations)
    run(Garbage(policy, after=10), observations, answers)
    found = answers.check()
    assert (found.looked, found.strays, found.first) == (24, 14, 10)
    assert found.worst > 0.1


def test_rounding_is_no_stray_and_no_number_is_one():
    answers = Answers([{"action": np.ones(4)}])
    answers.look(0, {"action": np.ones(4) * (1 + 1e-6)})
    assert answers.strays == 0
    answers.look(0, {"action": np.array([1, math.nan, 1, 1])})
    answers.look(0, {"action": np.ones(3)})
    assert answers.check() == AnswerCheck(looked=3, strays=2, worst=None, first=1)


def test_a_slow_policy_is_asked_few_observations(policy, observations):
    assert len(expected_answers(policy, observations, seconds=0.0)) == 2


def test_a_policy_that_remembers_is_caught_and_an_honest_one_is_not(policy, observations):
    assert not measure_caching(policy, observations).remembers
    memoising = Memoising(policy)
    expected_answers(memoising, observations)
    found = measure_caching(memoising, observations)
    assert found.remembers
    assert found.ratio >= found.low > 1.10
    assert found.pairs == 40


def test_observations_differ_a_little_where_they_can(policy, observations):
    fresh = vary_observation(observations[0], policy.spec, np.random.default_rng(0))
    assert fresh["instruction"] == observations[0]["instruction"]
    for name in ("image", "proprio"):
        mine, theirs = np.asarray(fresh[name], float), np.asarray(observations[0][name], float)
        assert fresh[name].dtype == np.asarray(observations[0][name]).dtype
        assert 0 < np.abs(mine - theirs).max() <= max(1.0, 0.01 * np.abs(theirs).max())
    assert policy.infer(fresh).chunk.shape == (4, 2)


def test_nothing_can_be_told_of_a_policy_that_takes_text_alone(policy, observations):
    class Reader:
        spec = PolicySpec(
            inputs=(TensorSpec("words", (1, 4), "int64", "text", tokenizer="v.json", max_tokens=4),),
            outputs=policy.spec.outputs,
            control_hz=10,
        )

    assert measure_caching(Reader(), [{"words": "go"}]) is None
