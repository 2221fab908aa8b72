"""Inferences of real engines that are stopped at a deadline, or cannot be: the policy lives on."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from _written import ENDLESS, MEMORY, SUM, X, written

from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DeadlineMissed
from vlatool.runtime import Policy
from vlatool.runtime.control.deadline import Deadline

TRIPS = TensorSpec("trips", (1,), "int64")
LOOP = ENDLESS.replace("(float[1,2] x) =>", "(float[1,2] x, int64[1] trips) =>").replace(
    "int64 trips = {4611686018427387904}, ", ""
)
SLOW_MS, QUICK_MS = 40.0, 20_000.0
ENGINES = pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])


def opened(folder: Path, text: str, engine: str = "ort_cpu", **more: object) -> Policy:
    return Policy.open(written(folder, text, **more), engine=engine, threads=1, seed=0)


def free(deadline: Deadline) -> bool:
    end = time.monotonic() + 20
    while deadline.busy and time.monotonic() < end:
        time.sleep(0.001)
    return not deadline.busy


def test_a_graph_without_end_is_stopped_time_after_time_and_then_the_policy_infers(tmp_path: Path):
    policy = opened(tmp_path, LOOP, inputs=(X, TRIPS))
    deadline, threads = Deadline(policy, SLOW_MS), []
    for _ in range(5):
        with pytest.raises(DeadlineMissed, match="it was stopped"):
            deadline.infer({"x": [1, 2], "trips": [2**62]})
        assert free(deadline)
        threads.append(threading.active_count())
    deadline.deadline_ms = QUICK_MS
    action = deadline.infer({"x": [1, 2], "trips": [3]})
    assert (action.chunk.tolist(), action.sequence) == ([[-1, -2]], 0)
    assert len(set(threads)) == 1
    deadline.close()


@ENGINES
def test_a_program_of_many_runs_is_stopped_on_either_engine(tmp_path: Path, engine: str, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", f"repeat={10**13},runs={10**13}")
    text = "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }"
    step = ProgramStep("main", {"x": "x"}, {"y": "y"}, repeat=10**9, carry={"y": "x"})
    deadline = Deadline(opened(tmp_path, text, engine, program=(step,)), SLOW_MS)
    for _ in range(2):
        with pytest.raises(DeadlineMissed, match="it was stopped"):
            deadline.infer({"x": [1, 2]})
        assert free(deadline)
    deadline.close()


@ENGINES
def test_in_time_all_is_as_without_a_deadline(tmp_path: Path, engine: str):
    plain = opened(tmp_path, SUM, engine, program=MEMORY)
    deadline = Deadline(Policy.open(plain.bundle, engine=engine, threads=1), QUICK_MS)
    for number in range(3):
        wanted, action = (each.infer({"x": [number, 1]}) for each in (plain, deadline))
        np.testing.assert_array_equal(action.chunk, wanted.chunk)
        assert action.sequence == wanted.sequence
    deadline.close()


class Held:
    """A session that waits after each run until it may go on, and cannot be stopped."""

    def __init__(self, session: object) -> None:
        self.session, self.go = session, threading.Event()

    def run(self, feeds: object) -> object:
        result = self.session.run(feeds)
        self.go.wait(20)
        return result


def test_a_late_result_is_never_used_and_what_the_policy_keeps_is_as_before(tmp_path: Path):
    """The sum of all inputs is kept: 1, then (discarded: 10), then 2."""
    policy = opened(tmp_path, SUM, program=MEMORY)
    held = Held(policy.program.sessions["main"])
    policy.program.sessions = {"main": held}
    deadline = Deadline(policy, QUICK_MS)
    held.go.set()
    assert deadline.infer({"x": [1, 1]}).chunk.tolist() == [[2, 2]]
    held.go.clear()
    deadline.deadline_ms = SLOW_MS
    with pytest.raises(DeadlineMissed):
        deadline.infer({"x": [10, 10]})
    assert deadline.busy
    started = time.monotonic()
    with pytest.raises(DeadlineMissed, match="has not ended yet"):
        deadline.infer({"x": [10, 10]})
    assert time.monotonic() - started < 10
    held.go.set()
    assert free(deadline)
    deadline.deadline_ms = QUICK_MS
    action = deadline.infer({"x": [2, 2]})
    assert (action.chunk.tolist(), action.sequence) == ([[6, 6]], 1)
    deadline.close()


def test_noise_and_earlier_moments_are_as_before_too(tmp_path: Path):
    text = "g (float[1,2,2] x, float[1,2] z) => (float[1,2] y) { s = ReduceSum<keepdims = 0>(x, a)  y = Add(s, z) }"
    text = text.replace("{ s", "<int64[1] a = {1}> { s", 1)
    step = ProgramStep("main", {"x": "x", "z": "z"}, {"y": "y"}, noise={"z": {"shape": [1, 2]}})
    moments = TensorSpec("x", (1, 2, 2), history=2)
    policy = opened(tmp_path, text, inputs=(moments,), program=(step,))
    other = Policy.open(policy.bundle, threads=1, seed=0)
    for each in (policy, other):
        each.infer({"x": [1, 1]})
    before = policy.snapshot
    policy.infer({"x": [5, 5]})
    policy.restore(before)
    np.testing.assert_array_equal(policy.infer({"x": [2, 2]}).chunk, other.infer({"x": [2, 2]}).chunk)
    before = policy.snapshot
    policy.infer({"x": [5, 5]})
    policy.observe({"x": [3, 3]})
    policy.restore(before)
    other.observe({"x": [3, 3]})
    np.testing.assert_array_equal(policy.infer({"x": [4, 4]}).chunk, other.infer({"x": [4, 4]}).chunk)


@ENGINES
def test_stop_holds_until_resume(tmp_path: Path, engine: str):
    policy = opened(tmp_path, "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", engine)
    policy.stop()
    assert policy.infer({"x": [1, 2]}).sequence == 0, "nobody asked for it to be stoppable"
    policy.resume()
    policy.stop()
    for _ in range(2):
        with pytest.raises(TimeoutError):
            policy.infer({"x": [1, 2]})
    policy.resume()
    assert policy.infer({"x": [1, 2]}).sequence == 1


def test_one_node_that_cannot_be_stopped_is_not_waited_for(tmp_path: Path):
    """In a process of its own, which ends all the same: nothing waits for the node."""
    from test_first_run_limits import ONE_NODE

    bundle = written(tmp_path, ONE_NODE)
    code = f"""
import time, threading
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DeadlineMissed
from vlatool.runtime import Policy
from vlatool.runtime.control.deadline import Deadline
deadline = Deadline(Policy.open(Bundle.open({str(bundle.path)!r}), threads=1), 200)
worst = 0.0
for tick in range(4):
    started = time.monotonic()
    try:
        deadline.infer({{"x": [1, 2]}})
    except DeadlineMissed:
        worst = max(worst, time.monotonic() - started)
print(worst, threading.active_count(), deadline.busy)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    worst, threads, busy = done.stdout.split()
    assert 0.2 <= float(worst) < 20
    assert (threads, busy) == ("2", "True")
