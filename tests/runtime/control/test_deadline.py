"""A policy that answers by its deadline: what comes late has no effect."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from _fake_clock import FakeClock, FakeWorker, SlowPolicy
from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DeadlineMissed, GraphError, PluginError, SpecError, UsageError
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.interface import Observer, Policy


class Stoppable(SlowPolicy):
    """Says when it was stopped, and goes back to a snapshot."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.calls: list[Any] = []

    def stop(self) -> None:
        self.calls.append("stop")

    def resume(self) -> None:
        self.calls.append("resume")

    @property
    def snapshot(self) -> int:
        return len(self.asked)

    def restore(self, snapshot: int) -> None:
        self.calls.append(("restore", snapshot))
        del self.asked[snapshot:]


def limited(*delays_ms: float, stops: bool = True, kind: type = Stoppable) -> tuple[Any, Deadline, FakeClock]:
    clock = FakeClock()
    policy = kind(spec_of(2), clock, list(delays_ms))
    return policy, Deadline(policy, 10.0, clock=clock, worker=FakeWorker(clock, stops)), clock


def test_in_time_it_is_the_policy():
    policy, deadline, _ = limited(9.9)
    assert isinstance(deadline, Policy)
    assert deadline.spec is policy.spec
    action = deadline.infer({"t": 3})
    assert (action.chunk[0, 0], action.latency_ms) == (300, 9.9)
    assert policy.calls == ["resume"]


def test_a_late_inference_is_stopped_and_taken_back():
    policy, deadline, clock = limited(0.0, 10.1, 95.0, 0.0)
    deadline.infer({"t": 0})
    for late in (1, 2):
        clock.now = float(late)
        with pytest.raises(DeadlineMissed, match=r"no action within 10 ms: it was stopped") as caught:
            deadline.infer({"t": late})
        assert clock.now == late + 0.01, "the answer comes at the deadline"
        assert isinstance(caught.value, GraphError)
    clock.now = 3.0
    assert deadline.infer({"t": 3}).sequence == 1
    assert policy.asked == [0, 3]
    assert policy.calls == ["resume", *["resume", "stop", ("restore", 1)] * 2, "resume"]


def test_the_deadline_counts_from_when_the_step_was_to_begin():
    _, deadline, clock = limited(6.0, 6.0)
    clock.now, deadline.started = 1.005, 1.0
    with pytest.raises(DeadlineMissed):
        deadline.infer({"t": 0})
    assert clock.now == pytest.approx(1.01)
    clock.now = 1.02
    with pytest.raises(DeadlineMissed, match="no time is left"):
        deadline.infer({"t": 0})
    deadline.started = None
    assert deadline.infer({"t": 0}).latency_ms == 6.0


def test_a_time_that_is_still_to_come_does_not_put_the_deadline_off():
    _, deadline, clock = limited(99.0)
    clock.now, deadline.started = 1.0, 1.7e9  # seconds since 1970, say
    with pytest.raises(DeadlineMissed):
        deadline.infer({"t": 0})
    assert clock.now == 1.01


def test_a_policy_that_cannot_be_stopped_is_busy_until_it_ends():
    _, deadline, clock = limited(35.0, stops=False, kind=SlowPolicy)
    misses = []
    for tick in range(5):
        clock.now = tick * 0.01
        try:
            deadline.infer({"t": tick})
        except DeadlineMissed as error:
            misses.append(error.message)
    assert ["has not ended yet" in message for message in misses] == [False, True, True, True]
    assert not deadline.busy


def test_a_reset_of_a_busy_policy_is_done_before_its_next_inference():
    policy, deadline, clock = limited(0.0, 35.0, stops=False)
    deadline.infer({"t": 0})
    with pytest.raises(DeadlineMissed):
        deadline.infer({"t": 1})
    deadline.reset(5)
    assert policy.seeds == []
    clock.now = 0.05
    deadline.infer({"t": 2})
    deadline.infer({"t": 3})
    assert policy.seeds == [5]
    deadline.reset()
    assert policy.seeds == [5, None]
    with pytest.raises(UsageError, match="seed"):
        deadline.reset(-1)


def test_what_the_policy_raises_in_time_is_raised():
    class Broken(SlowPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Any:
            raise GraphError("not finite")

    with pytest.raises(GraphError, match="not finite"):
        limited(kind=Broken)[1].infer({"t": 0})


def test_without_a_number_the_deadline_is_a_control_period():
    policy = NumberedPolicy(spec_of(hz=50.0))
    assert Deadline(policy).deadline_ms == 20
    for wrong in (0, -1, "5", float("nan"), True):
        with pytest.raises(UsageError, match="deadline_ms"):
            Deadline(policy, wrong)  # type: ignore[arg-type]
    unknown = PolicySpec((TensorSpec("t", (1, 1)),), policy.spec.outputs, None)
    with pytest.raises(SpecError, match="rate"):
        Deadline(NumberedPolicy(unknown))


def test_the_observation_of_a_step_without_an_inference_is_passed_on():
    moments = PolicySpec((TensorSpec("t", (1, 2, 1), history=2),), spec_of().outputs, 20.0)
    with pytest.raises(PluginError, match="observe"):
        Deadline(NumberedPolicy(moments))

    class Looking(NumberedPolicy):
        def observe(self, observation: Any) -> None:
            self.asked.append(observation)

    policy = Looking(moments)
    deadline = Deadline(policy)
    assert isinstance(deadline, Observer)
    deadline.observe({"t": 4})
    assert policy.asked == [{"t": 4}]


def test_a_second_policy_inside_of_wrappers_is_found_to_be_stopped():
    clock = FakeClock()
    policy = Stoppable(spec_of(2), clock, [20.0])
    wrapper = NumberedPolicy(policy.spec)
    wrapper.policy, wrapper.infer = policy, policy.infer
    with pytest.raises(DeadlineMissed):
        Deadline(wrapper, 10.0, clock=clock, worker=FakeWorker(clock)).infer({"t": np.float32(0)})
    assert policy.calls == ["resume", "stop", ("restore", 0)]
