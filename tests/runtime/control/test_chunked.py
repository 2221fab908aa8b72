"""Chunks that are played one control step at a time, each waited for."""

from __future__ import annotations

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import UsageError
from vlatool.runtime import Action, ChunkQueue, load
from vlatool.runtime.control.asynchronous import AsynchronousController
from vlatool.runtime.control.late import LateController
from vlatool.runtime.control.rtc import RealTimeController
from vlatool.runtime.interface import CHUNK, POLICY, Origin


def play(queue: ChunkQueue, steps: int) -> list[float]:
    return [queue.act({"t": step})[0].item() for step in range(steps)]


def test_the_whole_chunk_is_executed_by_default():
    policy = NumberedPolicy(spec_of(chunk=3))
    assert play(ChunkQueue(policy), 5) == [0, 1, 2, 300, 301]
    assert policy.asked == [0, 3]


def test_the_spec_says_how_much_of_a_chunk_is_executed():
    assert play(ChunkQueue(NumberedPolicy(spec_of(chunk=4, execute=2))), 5) == [0, 1, 200, 201, 400]


def test_the_caller_may_execute_another_part():
    assert play(ChunkQueue(NumberedPolicy(spec_of(chunk=4, execute=2)), execute=1), 3) == [0, 100, 200]


def test_reset_forgets_pending_actions_and_resets_the_policy():
    policy = NumberedPolicy(spec_of(chunk=4))
    queue = ChunkQueue(policy)
    assert play(queue, 2) == [0, 1]
    queue.reset()
    assert queue.act({"t": 5})[0] == 500
    queue.reset(3)
    assert policy.seeds == [None, 3]


def test_an_action_has_the_elements_of_the_spec(float_bundle, observation):
    policy = load(float_bundle.path, threads=1)
    queue = ChunkQueue(policy)
    chunk = policy.infer(observation).chunk
    for row in (0, 1, 0):
        action = queue.act(observation)
        assert action.shape == (2,)
        np.testing.assert_array_equal(action, chunk[row])


class Buttons(NumberedPolicy):
    """Infers chunks of indices."""

    def infer(self, observation, *, noise=None) -> Action:
        return Action(np.array([2, 0]), ("f", "l"), 0.0, 0, {})


def test_a_discrete_action_is_a_scalar():
    action = TensorSpec("a", (1, 2, 3), kind="discrete", labels=("l", "r", "f"))
    queue = ChunkQueue(Buttons(spec_of(chunk=2, action=action)))
    assert [queue.act({}).item() for _ in range(3)] == [2, 0, 2]
    assert queue.act({}).shape == ()


@pytest.mark.parametrize("player", [ChunkQueue, LateController, AsynchronousController, RealTimeController])
@pytest.mark.parametrize("execute", [3, 99, -1, 1.0, True])
def test_no_more_of_a_chunk_can_be_executed_than_it_has(player, execute):
    assert player(NumberedPolicy(spec_of(chunk=2)), 2).execute == 2
    with pytest.raises(UsageError, match="allowed: a whole number from 0 to 2"):
        player(NumberedPolicy(spec_of(chunk=2)), execute)


class Aged(NumberedPolicy):
    """Takes 4 ms for each chunk."""

    def infer(self, observation, *, noise=None) -> Action:
        return super().infer(observation)._replace(age_ms=4.0, checks=("bounds",))


def test_an_action_says_how_old_the_observation_is_that_it_answers():
    times = iter([1.0, 1.0, 1.05, 1.15, 1.2, 1.2])
    queue = ChunkQueue(Aged(spec_of(chunk=3)), clock=lambda: next(times))
    origins = []
    for step in range(4):
        queue.act({"t": step})
        origins.append(queue.origin)
    assert [origin.age_ms for origin in origins] == pytest.approx([4, 54, 154, 4])
    assert {(origin.source, origin.checks) for origin in origins} == {(POLICY, ("bounds",))}


def test_the_rest_of_a_chunk_is_there_for_steps_without_an_inference():
    queue = ChunkQueue(NumberedPolicy(spec_of(chunk=4, execute=2)), clock=lambda: 0.0)
    assert queue.rest() is None
    assert play(queue, 1) == [0]
    assert [queue.rest()[0].item() for _ in range(3)] == [1, 2, 3]
    assert (queue.origin, queue.fresh) == (Origin(CHUNK, 0.0), False)
    assert queue.rest() is None
    assert queue.act({"t": 7})[0] == 700
    queue.drop()
    assert queue.rest() is None
    assert queue.policy.seeds == []
    assert queue.act({"t": 8})[0] == 800
