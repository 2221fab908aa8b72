"""Asynchronous control: which actions are left out, how the delay is counted, and inferences in another thread."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _delays import scripted
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, UsageError
from vlatool.runtime.control._inference import BackgroundInference, Moments
from vlatool.runtime.control.asynchronous import AsynchronousController
from vlatool.runtime.interface import Action


def played(controller: AsynchronousController, steps: int) -> list[float]:
    return [float(controller.act({"t": t})[0]) for t in range(steps)]


def test_a_chunk_leaves_out_what_was_executed_since_its_observation():
    policy = NumberedPolicy(spec_of(8))
    controller = AsynchronousController(policy, delay=3)
    assert played(controller, 10) == [0, 1, 2, 3, 103, 104, 105, 403, 404, 405]
    assert policy.asked == [0, 1, 4, 7], "the first is waited for, and then there is no pause"


@pytest.mark.parametrize(("mode", "held"), [("delta", 0), ("velocity", 0), ("absolute", 3), ("", 3)])
def test_a_robot_that_held_has_executed_nothing(mode: str, held: float):
    policy = NumberedPolicy(spec_of(4, action=replace(MOVES, mode=mode)))
    controller = AsynchronousController(policy, delay=5)
    last = 103 if mode in ("absolute", "") else 0
    assert played(controller, 13) == [0, 1, 2, 3, held, held, 103, last, last, last, last, 601, 602]
    assert policy.asked == [0, 1, 6, 11]


def test_without_a_delay_each_step_infers():
    policy = NumberedPolicy(spec_of(4))
    controller = AsynchronousController(policy)
    assert played(controller, 4) == [0, 100, 200, 300]
    assert controller.expected_delay == 0


def test_the_delay_is_the_largest_of_the_last_and_the_first_inference_does_not_count():
    controller = scripted(AsynchronousController(NumberedPolicy(spec_of(9)), memory=3), [50, 2, 7, 1])
    expected = []
    for t in range(15):
        controller.act({"t": t})
        expected.append(controller.expected_delay)
    assert expected == [0, 0, 0, 2, 2, 2, 2, 2, 2, 2, 7, 7, 7, 1, 1]


def test_until_one_is_counted_the_delay_is_the_given_one():
    controller = AsynchronousController(NumberedPolicy(spec_of(9)), delay=4)
    controller.act({"t": 0})
    assert controller.expected_delay == 4


@pytest.mark.parametrize("arguments", [{"delay": -1}, {"delay": 1.5}, {"memory": 0}, {"execute": 5}])
def test_numbers_out_of_range_are_refused(arguments: Mapping[str, Any]):
    with pytest.raises(UsageError, match="allowed: a whole number from"):
        AsynchronousController(NumberedPolicy(spec_of(4)), **arguments)


class Gated(NumberedPolicy):
    """Infers when a test lets it; negative times raise."""

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        self.gate = threading.Semaphore(0)
        self.threads: set[int] = set()

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        self.gate.acquire(timeout=10)
        self.threads.add(threading.get_ident())
        if np.asarray(observation["t"]).item() < 0:
            raise DataError("a negative time")
        return super().infer(observation, noise=noise)


def answered(controller: AsynchronousController) -> None:
    """Wait until the thread has an answer for the next step."""
    inference: Any = controller._inference
    end = time.monotonic() + 10
    while inference._answers.empty() and time.monotonic() < end:
        time.sleep(0.0005)


def test_in_the_background_the_delay_is_what_it_takes():
    policy = Gated(spec_of(8))
    controller = AsynchronousController(policy, background=True)
    policy.gate.release()
    moving = np.zeros((1, 1), np.float32)
    actions = []
    for t in range(6):
        moving[:] = t  # the robot's own array changes while the thread infers
        actions.append(float(controller.act({"t": moving})[0]))
        if t == 3:
            policy.gate.release()
            answered(controller)
    assert actions == [0, 1, 2, 3, 103, 104]
    assert controller.expected_delay == 3
    assert threading.get_ident() not in policy.threads
    policy.gate.release(2)


def test_an_error_in_the_background_is_raised_at_a_step_and_the_next_one_tries_again():
    policy = Gated(spec_of(8))
    controller = AsynchronousController(policy, background=True)
    policy.gate.release(9)
    controller.act({"t": 0})
    controller.act({"t": -1})
    answered(controller)
    with pytest.raises(DataError, match="a negative time"):
        controller.act({"t": 2})
    assert float(controller.act({"t": 3})[0]) == 2
    answered(controller)
    assert float(controller.act({"t": 4})[0]) == 301, "one action was executed since the observation of step 3"


def test_a_reset_discards_the_inference_in_progress():
    policy = Gated(spec_of(8))
    controller = AsynchronousController(policy, background=True)
    policy.gate.release(9)
    controller.act({"t": 0})
    controller.act({"t": 1})
    controller.reset(5)
    assert policy.seeds == [5]
    assert float(controller.act({"t": 7})[0]) == 700


def test_the_thread_ends_with_the_controller():
    others = set(threading.enumerate())
    inference = BackgroundInference(NumberedPolicy(spec_of(8)))
    inference.start({"t": 0})
    inference.wait()
    (thread,) = set(threading.enumerate()) - others
    del inference
    gc.collect()
    thread.join(timeout=10)
    assert not thread.is_alive()


def test_moments_of_a_history_are_given_whole_with_the_first_before_them():
    spec = PolicySpec((TensorSpec("x", (1, 3, 2), history=3), TensorSpec("t", (1, 1))), (MOVES,), 20)
    moments = Moments(spec)
    assert moments.lengths == {"x": 3}
    first = moments.add({"x": np.array([0.0, 1.0]), "t": 5, "unused": 1})
    np.testing.assert_array_equal(first["x"], [[0, 1]] * 3)
    assert set(first) == {"x", "t"}
    moments.add({"x": np.array([[2.0, 3.0]]), "t": 5})
    np.testing.assert_array_equal(moments.add({"x": np.array([4.0, 5.0]), "t": 6})["x"], [[0, 1], [2, 3], [4, 5]])
    with pytest.raises(DataError, match="moments of 'x' have different shapes"):
        moments.add({"x": np.zeros(3), "t": 6})
    moments.clear()
    np.testing.assert_array_equal(moments.add({"x": np.array([6.0, 7.0]), "t": 7})["x"], [[6, 7]] * 3)


def test_each_action_says_where_it_came_from_and_how_old_its_observation_is():
    ticks = iter(range(1000))
    controller = AsynchronousController(NumberedPolicy(spec_of(4)), delay=5)
    controller._clock = lambda: float(next(ticks))
    sources, ages = [], []
    for t in range(7):
        controller.act({"t": t})
        sources.append(controller.origin.source)
        ages.append(controller.origin.age_ms)
    assert sources == ["policy"] * 4 + ["hold"] * 2 + ["policy"]
    assert all(age is not None and age > 0 for age in ages)


def test_the_rest_of_a_chunk_answers_a_step_and_counts_as_executed():
    controller = AsynchronousController(NumberedPolicy(spec_of(4)), delay=2)
    controller.act({"t": 0})
    controller.act({"t": 1})
    action = controller.rest()
    assert action is not None
    assert (float(action[0]), controller.origin.source, controller.fresh) == (2, "chunk", False)
    assert float(controller.act({"t": 3})[0]) == 102, "two were executed since the observation of step 1"
