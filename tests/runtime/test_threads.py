"""Calls from several threads: right answers or a clear error, never a wrong answer."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _numbered import NumberedPolicy, spec_of
from _written import MEMORY, SUM, written

from vlatool.errors import UsageError
from vlatool.runtime import Action, ChunkQueue, Policy, load
from vlatool.runtime.program import Program

THREADS, CALLS = 8, 250
NEG = "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }"


def in_threads(work: Callable[[int], Any], count: int = THREADS) -> list[Any]:
    """Run the work in threads that start together; return what they return or raise."""
    begin = threading.Barrier(count)
    found: list[Any] = [None] * count

    def run(number: int) -> None:
        begin.wait(30)
        try:
            found[number] = work(number)
        except Exception as error:
            found[number] = error

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()
    return found


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_every_thread_gets_the_answers_to_its_own_observations(tmp_path: Path, engine):
    policy = load(written(tmp_path, NEG).path, engine=engine, threads=1)

    def wrong(number: int) -> int:
        count = 0
        for call in range(CALLS):
            value = number * CALLS + call
            count += policy.infer({"x": [value, number]}).chunk.tolist() != [[-value, -number]]
        return count

    assert in_threads(wrong) == [0] * THREADS
    assert policy.infer({"x": [0, 0]}).sequence == THREADS * CALLS


class Slow:
    """A session that can be held in the middle of a run."""

    def __init__(self) -> None:
        self.entered, self.leave = threading.Event(), threading.Event()
        self.inside: Callable[[], Any] = lambda: None

    def run(self, feeds: Any) -> Any:
        self.entered.set()
        self.inside()
        assert self.leave.wait(30)
        return {"y": feeds["x"], "n": feeds["x"]}


def slow_policy(folder: Path, *, keeps: bool) -> tuple[Policy, Slow]:
    bundle = written(folder, SUM if keeps else NEG, program=MEMORY if keeps else ())
    session = Slow()
    return Policy(bundle, Program(bundle.manifest.program, {"main": session}), "slow"), session


def test_calls_that_overlap_on_a_policy_with_memory_are_refused(tmp_path: Path):
    policy, session = slow_policy(tmp_path, keeps=True)
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(policy.infer({"x": [1, 2]})))
    thread.start()
    assert session.entered.wait(30)
    with pytest.raises(UsageError, match="keeps values between steps") as caught:
        policy.infer({"x": [3, 4]})
    assert "one policy for each thread" in caught.value.fix
    session.leave.set()
    thread.join(30)
    assert results[0].chunk.tolist() == [[1, 2]]
    assert policy.infer({"x": [3, 4]}).sequence == 1


def test_a_reset_waits_for_the_inference_of_another_thread(tmp_path: Path):
    policy, session = slow_policy(tmp_path, keeps=True)
    thread = threading.Thread(target=policy.infer, args=({"x": [1, 2]},))
    thread.start()
    assert session.entered.wait(30)
    reset = threading.Thread(target=policy.reset)
    reset.start()
    reset.join(0.05)
    assert reset.is_alive()
    session.leave.set()
    thread.join(30)
    reset.join(30)
    assert policy.infer({"x": [3, 4]}).sequence == 0


@pytest.mark.parametrize("call", ["infer", "reset"])
def test_a_call_within_a_call_of_the_same_thread_is_refused_and_does_not_hang(tmp_path: Path, call):
    policy, session = slow_policy(tmp_path, keeps=False)
    session.leave.set()
    arguments = ({"x": [1, 2]},) if call == "infer" else ()
    session.inside = lambda: getattr(policy, call)(*arguments)
    with pytest.raises(UsageError, match="again during an inference, in the same thread"):
        policy.infer({"x": [1, 2]})
    session.inside = lambda: None
    assert policy.infer({"x": [1, 2]}).sequence == 0


def test_a_policy_goes_from_one_thread_to_another(tmp_path: Path):
    policy = load(written(tmp_path, SUM, program=MEMORY).path)
    for step in range(1, 4):
        assert in_threads(lambda _: policy.infer({"x": [1, 1]}).chunk.tolist(), 1) == [[[2 * step, 2 * step]]]


def test_steps_of_a_queue_that_overlap_are_refused(tmp_path: Path):
    policy, session = slow_policy(tmp_path, keeps=False)
    queue = ChunkQueue(policy)
    thread = threading.Thread(target=queue.act, args=({"x": [1, 2]},))
    thread.start()
    assert session.entered.wait(30)
    with pytest.raises(UsageError, match="before the last one has ended"):
        queue.act({"x": [3, 4]})
    session.leave.set()
    thread.join(30)
    np.testing.assert_array_equal(queue.act({"x": [3, 4]}), [3, 4])


def test_every_action_of_a_queue_is_given_once():
    chunks = iter(range(10**6))

    def infer(_: Any, *, noise: Any = None) -> Any:
        time.sleep(0)
        first = next(chunks) * 5
        return Action(np.arange(first, first + 5, dtype=np.float32)[:, None], (), 0.0, 0, {})

    policy = NumberedPolicy(spec_of(chunk=5))
    policy.infer = infer  # type: ignore[method-assign]
    queue = ChunkQueue(policy)

    def act(_: int) -> list[float]:
        found = []
        for _call in range(CALLS):
            try:
                found.append(queue.act({}).item())
            except UsageError:
                continue
        return found

    given = [each for found in in_threads(act) for each in found]
    assert sorted(given) == list(range(len(given)))
    assert len(given) >= CALLS
