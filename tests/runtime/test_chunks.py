from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vlatool.runtime import ChunkQueue, load


class Counting:
    """A policy whose k-th chunk holds 10 k, 10 k + 1, ..."""

    def __init__(self, chunk: int = 4, execute: int = 0) -> None:
        self.spec = SimpleNamespace(chunk=chunk, execute=execute)
        self.seen: list[Any] = []
        self.resets = 0

    def infer(self, observation: Any) -> Any:
        self.seen.append(observation)
        first = 10 * (len(self.seen) - 1)
        return SimpleNamespace(chunk=np.arange(first, first + self.spec.chunk, dtype=np.float32)[:, None])

    def reset(self) -> None:
        self.resets += 1


def play(queue: ChunkQueue, steps: int) -> list[float]:
    return [queue.act({"step": step}).item() for step in range(steps)]


def test_the_whole_chunk_is_executed_by_default():
    policy = Counting(chunk=3)
    assert play(ChunkQueue(policy), 5) == [0, 1, 2, 10, 11]
    assert policy.seen == [{"step": 0}, {"step": 3}]


def test_the_spec_says_how_much_of_a_chunk_is_executed():
    assert play(ChunkQueue(Counting(chunk=4, execute=2)), 5) == [0, 1, 10, 11, 20]


def test_the_caller_may_execute_another_part():
    assert play(ChunkQueue(Counting(chunk=4, execute=2), execute=1), 3) == [0, 10, 20]


def test_reset_forgets_pending_actions_and_resets_the_policy():
    policy = Counting(chunk=4)
    queue = ChunkQueue(policy)
    assert play(queue, 2) == [0, 1]
    queue.reset()
    assert play(queue, 1) == [10]
    assert policy.resets == 1


def test_an_action_has_the_elements_of_the_spec(float_bundle, observation):
    policy = load(float_bundle.path, threads=1)
    queue = ChunkQueue(policy)
    chunk = policy.infer(observation).chunk
    for row in (0, 1, 0):
        action = queue.act(observation)
        assert action.shape == (2,)
        np.testing.assert_array_equal(action, chunk[row])


def test_a_discrete_action_is_a_scalar():
    policy = Counting(chunk=2)
    policy.infer = lambda observation: SimpleNamespace(chunk=np.array([2, 0]))  # type: ignore[method-assign]
    queue = ChunkQueue(policy)
    assert [queue.act({}).item() for _ in range(3)] == [2, 0, 2]
    assert queue.act({}).shape == ()


@pytest.mark.parametrize("execute", [5, 9])
def test_more_than_the_chunk_is_the_chunk(execute):
    assert play(ChunkQueue(Counting(chunk=2), execute), 3) == [0, 1, 10]
