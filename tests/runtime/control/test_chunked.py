"""Chunks that are played one control step at a time, each waited for."""

from __future__ import annotations

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime import Action, ChunkQueue, load


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


@pytest.mark.parametrize("execute", [5, 9])
def test_more_than_the_chunk_is_the_chunk(execute):
    assert play(ChunkQueue(NumberedPolicy(spec_of(chunk=2)), execute), 3) == [0, 1, 200]
