"""The layers between a policy and a robot: in their one order, each asked for by an argument of ``load``."""

from __future__ import annotations

import gc
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _fake_clock import FakeClock, FakeWorker, SlowPolicy
from _numbered import MOVES, NumberedPolicy, spec_of
from _written import written

from vlatool import registry
from vlatool.bundle.conversion import Conversion
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DeadlineMissed, GraphError, ProfileError, UsageError
from vlatool.runtime import Policy, load
from vlatool.runtime.control import check_order, layers
from vlatool.runtime.control.action_check import CheckedPolicy
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.control.fallback import FallbackLadder
from vlatool.runtime.control.late import LateController
from vlatool.runtime.envelope import RobotLimits
from vlatool.runtime.interface import CHUNK, FALLBACK, HOLD, POLICY, STOP, Action, Controller, Origin, origin_of
from vlatool.runtime.stack import SWITCH_S, Fallback, Stack, TickRecord, build_stack, prepare_process
from vlatool.runtime.telemetry import PARTS

POSITIONS = TensorSpec("a", (1, 1, 2), labels=("x", "gripper"), mode="absolute")


class Bounded:
    """An envelope: no action above 150."""

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self.origin = Origin("")

    fresh = property(lambda self: self.controller.fresh)

    def act(self, observation: Any) -> Any:
        action = self.controller.act(observation)
        within = np.minimum(action, np.float32(150))
        self.origin = origin_of(self.controller)
        if (within != action).any():
            self.origin = self.origin.altered_by("bounds")
        return within

    def reset(self, seed: int | None = None) -> None:
        self.controller.reset(seed)


class Stopping(Bounded):
    """Also knows how to stop."""

    stops = 0

    def stop(self) -> Any:
        self.stops += 1
        return np.full(2, -self.stops, np.float32)


def fake(stack: Stack, clock: FakeClock) -> Stack:
    for deadline in stack.deadlines:
        deadline._worker = FakeWorker(clock)
    return stack


def built(delays_ms: list[float] = [], **more: Any) -> tuple[Any, Stack, FakeClock]:  # noqa: B006 - not changed
    clock = FakeClock()
    policy = SlowPolicy(spec_of(2, 1, POSITIONS), clock, delays_ms)
    return policy, fake(build_stack(policy, clock=clock, **more), clock), clock


def names(stack: Stack) -> list[str]:
    return [type(layer).__name__ for layer in stack.layers]


@pytest.mark.parametrize(
    ("asked", "expected"),
    [({}, "ChunkQueue CheckedPolicy"), ({"deadline_ms": 10}, "FallbackLadder ChunkQueue Deadline CheckedPolicy"),
     ({"envelope": Bounded}, "Bounded ChunkQueue CheckedPolicy"),
     ({"fallback": Fallback()}, "FallbackLadder ChunkQueue CheckedPolicy"),
     ({"envelope": Bounded, "deadline_ms": 50, "controllers": ["late"]},
      "Bounded FallbackLadder LateController Deadline CheckedPolicy")],
)  # fmt: skip
def test_each_layer_is_where_it_belongs(asked: dict[str, Any], expected: str):
    policy, stack, _ = built(**asked)
    assert names(stack) == [*expected.split(), "SlowPolicy"]
    assert isinstance(stack, Controller)
    assert (stack.policy, stack.spec) == (policy, policy.spec)


def test_an_action_goes_through_all_layers_and_says_so():
    records: list[TickRecord] = []
    _, stack, clock = built([4.0, 2.0, 99.0, 99.0], deadline_ms=10, envelope=Bounded, telemetry=records.append)
    for step in range(4):
        clock.now = step * 0.05 + 0.001
        action = stack.act({"t": step}, scheduled=step * 0.05)
        assert action[0] == [0, 100, 101, 101][step]
        assert stack.telemetry.flush()
        np.testing.assert_array_equal(records[-1].action, action)
    assert [record.origin.source for record in records] == [POLICY, POLICY, CHUNK, HOLD]
    assert [record.missed for record in records] == [False, False, True, True]
    assert [record.answer_ms for record in records] == pytest.approx([5, 3, 10, 10]), "from when it was to begin"
    assert [record.waited_ms for record in records] == pytest.approx([1] * 4)
    assert "no action within 10 ms" in records[2].error
    assert [(record.step, record.rung, record.level) for record in records[2:]] == [(2, 1, 0), (3, 2, 0)]
    _, stack, _ = built(envelope=Bounded)
    stack.act({"t": 7})
    assert stack.origin.checks == ("bounds",)


def test_an_envelope_stops_the_robot_itself_where_it_can():
    records: list[TickRecord] = []
    _, stack, clock = built([0.0, 0.0, *[99.0] * 3], deadline_ms=10, envelope=Stopping, telemetry=records.append)
    first = [float(stack.act({"t": step})[0]) for step in range(6) for clock.now in [step * 0.05]]
    assert first == [0, 100, 101, -1, -2, -3], "the third miss escalates, and recovery takes five"
    stack.close()
    assert [record.origin.source for record in records] == [POLICY, POLICY, CHUNK, STOP, STOP, STOP]


def test_a_second_policy_has_its_part_of_the_deadline():
    clock = FakeClock()
    first, second = (SlowPolicy(spec_of(1, action=POSITIONS), clock, [late, 4.0]) for late in (99.0, 4.0))
    options = Fallback(second, policy_ms=4.0)
    stack = fake(build_stack(first, deadline_ms=10, fallback=options, clock=clock), clock)
    assert [deadline.deadline_ms for deadline in stack.deadlines] == [6, 10]
    assert stack.act({"t": 3})[0] == 300
    assert (stack.origin, clock.now) == (Origin(FALLBACK, 4.0), pytest.approx(0.01))
    with pytest.raises(UsageError, match=r"10 of 10 ms are kept for the second policy; nothing is left"):
        build_stack(first, deadline_ms=10, fallback=Fallback(second, policy_ms=10.0))
    assert build_stack(first, deadline_ms=10, fallback=second).deadlines[0].deadline_ms == 5


@pytest.mark.parametrize(
    ("other", "message"),
    [(spec_of(2), "has the mode 'delta', that of the first 'absolute'"),
     (spec_of(2, action=TensorSpec("a", (1, 1, 2), labels=("y", "gripper"), mode="absolute")), "has the labels"),
     (spec_of(2, action=TensorSpec("a", (1, 1, 3), mode="absolute")), "has the labels"),
     (spec_of(2, action=POSITIONS, hz=10.0), "at 10.0 Hz"),
     (spec_of(2, action=TensorSpec("a", (1, 1, 2), labels=("x", "gripper"), mode="absolute", unit="mm")), "acts in")],
)  # fmt: skip
def test_a_second_policy_whose_actions_mean_something_else_is_refused(other: PolicySpec, message: str):
    with pytest.raises(UsageError, match=message):
        built(fallback=NumberedPolicy(other))


def test_what_a_policy_of_others_gives_wrong_never_reaches_the_robot():
    random = np.random.default_rng(0)

    class Wrong(NumberedPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Any:
            action = super().infer(observation)
            return action if observation["t"] % 7 == 0 else action._replace(chunk=_corrupted(action.chunk, random))

    stack = build_stack(Wrong(spec_of(2, 1, POSITIONS)), fallback=Fallback(misses=10**6, window=10**6, hold_s=1e6))
    for step in range(2000):
        action = stack.act({"t": step})
        assert (action.shape, action.dtype) == ((2,), np.float32)
        assert int(action[0]) // 100 % 7 == 0
    assert stack.ladder is not None
    assert stack.ladder.level == 0


def _corrupted(chunk: Any, random: np.random.Generator) -> Any:
    kind = random.integers(6)
    if kind < 3:
        worse = chunk.copy()
        worse[random.integers(len(chunk)), random.integers(2)] = [np.nan, np.inf, -np.inf][kind]
        return worse
    return (chunk[:, :1], chunk[:1], chunk.astype([np.float64, np.float16, np.int64][random.integers(3)]))[kind - 3]


def test_a_sink_that_fails_does_not_stop_the_robot():
    def full(record: TickRecord) -> None:
        raise OSError("no space left on device")

    _, stack, _ = built(telemetry=full)
    assert stack.act({"t": 1})[0] == 100
    stack.close()
    assert stack.failed_records == 1
    assert stack.telemetry.outlets[0].error == "OSError: no space left on device"


def test_an_error_is_recorded_and_raised_where_nothing_answers():
    records: list[TickRecord] = []
    _, stack, _ = built([99.0], deadline_ms=10, telemetry=records.append)
    with pytest.raises(DeadlineMissed):
        stack.act({"t": 0})
    stack.close()
    assert (records[0].missed, records[0].action, records[0].origin) == (True, None, Origin(""))


@pytest.mark.parametrize("wrong", [0, -5, float("inf") * -1, "10"])
def test_a_deadline_that_is_none_is_refused(wrong: Any):
    with pytest.raises(UsageError, match="deadline_ms"):
        built(deadline_ms=wrong)


def test_a_deadline_longer_than_a_step_is_refused_where_the_step_waits_for_it():
    with pytest.raises(UsageError, match="60 ms is longer than the control period of 50 ms") as caught:
        built(deadline_ms=60)
    assert "up to 50" in caught.value.fix
    with pytest.raises(UsageError, match="longer than the control period"):  # it infers within act
        built(deadline_ms=60, controllers=["rtc"])
    assert built(deadline_ms=60, controllers=["rtc:background=true"])[1].deadlines[0].deadline_ms == 60


@pytest.mark.parametrize(
    ("named", "period"),
    [(["deadline:deadline_ms=60"], 50), (["deadline:deadline_ms=60", "rtc"], 50),
     (["deadline:deadline_ms=11", "interpolation:factor=5"], 10), (["deadline", "interpolation:factor=2"], 25)],
)  # fmt: skip
def test_a_deadline_by_name_is_no_longer_than_a_step_either(named: list[str], period: int):
    with pytest.raises(UsageError, match=f"longer than the control period of {period} ms"):
        built(controllers=named)


def test_a_deadline_by_name_that_fits_is_there():
    for named in (["deadline"], ["deadline:deadline_ms=60", "rtc:background=true"]):
        assert len(built(controllers=named)[1].deadlines) == 1


def test_a_faster_control_loop_has_a_shorter_step():
    with pytest.raises(UsageError, match="11 ms is longer than the control period of 10 ms"):
        built(deadline_ms=11, controllers=["interpolation:factor=5"])
    assert built(deadline_ms=10, controllers=["interpolation:factor=5"])[1].deadlines[0].deadline_ms == 10


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("hold_s", float("nan")), ("hold_s", -1), ("hold_s", float("inf")), ("hold_s", "1"), ("ramp_s", None),
     ("ramp_s", float("nan")), ("policy_ms", 0), ("policy_ms", float("nan")), ("max_age_ms", "80"),
     ("max_age_ms", -5)],
)  # fmt: skip
def test_a_number_of_a_fallback_that_is_out_of_its_range_is_refused(name: str, wrong: Any):
    with pytest.raises(UsageError, match=f"^{name} is .*; allowed: "):
        Fallback(**{name: wrong})


@pytest.mark.parametrize("pose", [[1], [1, 2, 3], [float("nan"), 0], "home", [[1, 2]]])
def test_a_start_that_is_no_pose_of_the_robot_is_refused(pose: Any):
    with pytest.raises(UsageError, match="allowed: 2 finite numbers"):
        build_stack(NumberedPolicy(spec_of(2, 1, POSITIONS)), fallback=Fallback(start=pose))


def test_a_label_without_motion_is_refused_where_the_action_has_no_labels_to_choose_from():
    with pytest.raises(UsageError, match="neutral is 'stop', and the action 'a' is not discrete"):
        build_stack(NumberedPolicy(spec_of(2, 1, POSITIONS)), fallback=Fallback(neutral="stop"))


@pytest.mark.parametrize(
    ("asked", "message"),
    [({"controllers": "rtc"}, "controllers is 'rtc'; allowed: a list"), ({"controllers": [3]}, "allowed: a list"),
     ({"controllers": 3}, "controllers is 3"), ({"envelope": 3}, "envelope is 3; allowed: the name of a robot"),
     ({"telemetry": "log.jsonl"}, "telemetry is 'log.jsonl'; allowed: a function"),
     ({"fallback": 3}, "The fallback is 3; allowed: a policy")],
)  # fmt: skip
def test_an_argument_of_another_type_is_refused(asked: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        build_stack(NumberedPolicy(spec_of(2, 1, POSITIONS)), **asked)


def test_an_order_that_makes_no_sense_is_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(registry, "entry_of", lambda kind: "control.envelope" if kind is Bounded else
                        f"control.{kind.__module__.rpartition('.')[2]}")  # fmt: skip
    right = [CheckedPolicy, Deadline, ChunkQueue, FallbackLadder, Bounded]
    assert check_order(right) == right
    for wrong, reason in (
        ([Deadline, CheckedPolicy], "CheckedPolicy cannot be around Deadline: the deadline does not limit the time"),
        ([Deadline, Deadline], "there is one deadline"), ([ChunkQueue, LateController], "one player plays"),
        ([ChunkQueue, Deadline], "a wrapper of a policy needs a policy"),
        ([ChunkQueue, Bounded, FallbackLadder], "would change an action after the envelope has checked it"),
        ([ChunkQueue, FallbackLadder, FallbackLadder], "one fallback answers"),
        ([ChunkQueue, Bounded, Bounded], "an action is checked once"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=reason):
            check_order(wrong)


def test_layers_by_name_are_put_in_their_order():
    with pytest.raises(UsageError, match="CheckedPolicy cannot be around Deadline"):
        layers(["deadline", "action_check"])
    assert layers(["fallback", "action_check", "deadline"]) == [CheckedPolicy, Deadline, ChunkQueue, FallbackLadder]


@pytest.mark.parametrize("twice", ["deadline", "fallback"])
def test_a_layer_that_is_named_and_asked_for_is_there_twice_and_refused(twice: str):
    with pytest.raises(UsageError, match=f"one {twice}"):
        built(deadline_ms=10, controllers=[twice])


def test_load_gives_the_policy_unless_a_layer_is_asked_for(tmp_path: Path):
    path = written(tmp_path, "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }").path
    assert type(load(path, threads=1, engine="auto")) is Policy
    interval = sys.getswitchinterval()
    try:
        hold = Fallback(start=[0.0, 0.0])
        stack = load(path, threads=1, deadline_ms=50, fallback=hold, envelope=Bounded, telemetry=print)
        assert isinstance(stack, Stack)
        assert names(stack) == ["Bounded", "FallbackLadder", "ChunkQueue", "Deadline", "BundlePolicy"]
        assert stack.act({"x": [1, 2]}).tolist() == [-1, -2]
        assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
        stack.reset(3)
        stack.close()
        backed = load(path, threads=1, deadline_ms=50, fallback=path)
        assert isinstance(backed, Stack)
        assert [deadline.deadline_ms for deadline in backed.deadlines] == [25, 50]
        assert isinstance(load(path, threads=1, controllers=["late"]).controller, LateController)
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()


def test_a_shorter_switch_interval_is_left_as_it_is():
    interval = sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-4)
        prepare_process()
        assert sys.getswitchinterval() < 1.1e-4
        assert gc.get_freeze_count() > 0
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()


JOINTS = tuple(joint.name for joint in RobotLimits.named("franka-panda").joints)
READY = [0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8]
"""A pose within the limits, rad."""


class Reaching(NumberedPolicy):
    """Moves the first joint by a hundredth of a rad each step, until it fails."""

    fails_from = 30

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        step = observation["t"]
        if step >= self.fails_from:
            raise GraphError("not finite")
        pose = np.array([READY], np.float32)
        pose[0, 0] += 0.01 * min(step, 10) ** 2 / 20 + 0.01 * max(0, step - 10)
        return Action(pose, JOINTS, 0.0, step, {})


def panda(**labels: Any) -> Any:
    action = TensorSpec("a", (1, 1, 7), labels=JOINTS, mode="absolute", unit="rad")
    seen = TensorSpec("q", (1, 7), **{"labels": JOINTS, **labels})
    return Reaching(PolicySpec((seen,), (action,), 50.0))


def test_a_robot_by_name_is_stopped_as_its_envelope_has_proven_where_the_policy_fails():
    stack = build_stack(panda(), fallback=Fallback(misses=3), envelope="franka-panda")
    played = [stack.act({"t": step, "q": np.array(READY)}) for step in range(60) if not pace(stack)]
    sources = [type(stack.controller).__name__, stack.origin.source]
    assert sources == ["EnvelopeController", STOP]
    place = np.array(played)[:, 0]
    speeds = np.diff(place) * 50
    assert place[28] < place[29] <= place[30] <= place[59], "it slows down and does not go back"
    assert abs(speeds[-5:]).max() < 1e-6, "and stands still"
    assert abs(np.diff(speeds) * 50).max() < 15.1, "rad/s^2"


def pace(stack: Any, period_s: float = 0.02) -> None:
    """Let the envelope see a control period go by."""
    envelope = stack.controller.envelope
    envelope.clock = lambda: envelope._time + period_s if envelope.ready else 0.0


@pytest.mark.parametrize("factor", [1, 5, 20])
def test_the_envelope_of_a_faster_control_loop_has_its_period(factor: int):
    stack = build_stack(panda(), controllers=[f"interpolation:factor={factor}"], envelope="franka-panda")
    for step in range(29):
        pace(stack, 0.02 / factor)
        stack.act({"t": step, "q": np.array(READY)})
        assert "early" not in stack.controller.result.checks
    assert stack.controller.envelope.period_s == pytest.approx(0.02 / factor)


@pytest.mark.parametrize(
    ("robot", "policy", "error", "message"),
    [("no-such-robot", panda(), ProfileError, "no-such-robot"),
     ("franka-panda", NumberedPolicy(spec_of()), UsageError, "has 2 elements"),
     ("franka-panda", panda(labels=()), UsageError, "0 inputs have the labels of the action"),
     ("franka-panda", panda(unit="deg"), UsageError, "'q' measures .*joint1 in deg; its limits are in rad"),
     ("franka-panda", panda(unit=("rad",) * 6 + ("m",)), UsageError, "'q' measures .*joint7 in m")],
    ids=["robot", "width", "position", "unit", "unit of one"],
)  # fmt: skip
def test_limits_that_do_not_fit_are_refused(robot: str, policy: Any, error: type, message: str):
    with pytest.raises(error, match=message):
        build_stack(policy, envelope=robot)


def test_velocities_ramp_down_in_the_time_that_is_asked_for():
    clock = FakeClock()
    speeds = TensorSpec("a", (1, 1, 2), labels=("x", "y"), mode="velocity")
    policy = SlowPolicy(spec_of(1, action=speeds), clock, [0.0, 0.0, *[99.0] * 9])
    stack = fake(build_stack(policy, deadline_ms=10, fallback=Fallback(ramp_s=0.2, misses=99), clock=clock), clock)
    assert [stack.act({"t": step})[0] for step in range(6) for clock.now in [step * 0.05]] == [0, 100, 75, 50, 25, 0]


def test_moves_are_zero_without_an_action():
    clock = FakeClock()
    policy = SlowPolicy(spec_of(1, action=MOVES), clock, [99.0])
    stack = fake(build_stack(policy, deadline_ms=10, clock=clock), clock)
    assert stack.act({"t": 0}).tolist() == [0, 0]


@pytest.mark.parametrize(
    "wrong",
    [{"max_age_ms": float("nan")}, {"max_age_ms": -1}, {"hold_s": float("nan")}, {"hold_s": float("inf")},
     {"ramp_s": -1.0}, {"ramp_s": "1"}, {"policy_ms": 5.0}, {"latch": "no"}, {"policy": "hold"}, {"neutral": "gripper"},
     {"start": [1.0]}, {"start": [float("nan"), 1.0]}, {"start": "abc"}, {"policy": 5}],
    ids=str,
)  # fmt: skip
def test_an_option_of_a_fallback_that_cannot_be_kept_is_refused(wrong: dict[str, Any]):
    with pytest.raises(UsageError) as caught:
        built(fallback=Fallback(**wrong))
    assert caught.value.fix


def test_a_part_of_no_deadline_is_refused():
    second = NumberedPolicy(spec_of(2, 1, POSITIONS))
    with pytest.raises(UsageError, match="part of the deadline, and there is none"):
        built(fallback=Fallback(second, policy_ms=5.0))


@pytest.mark.parametrize(
    ("asked", "message"),
    [({"deadline_ms": float("inf"), "controllers": ["asynchronous"]}, "deadline_ms is inf"),
     ({"envelope": 5}, "envelope is 5"), ({"envelope": lambda _: None}, "returns a controller"),
     ({"envelope": lambda _: ChunkQueue(NumberedPolicy(spec_of()))}, "around the one that it is given"),
     ({"telemetry": []}, r"telemetry is \[\]"), ({"fallback": True}, "The fallback is True"),
     ({"controllers": ["rtc:blend=2", "rtc:blend=4"]}, "named twice"), ({"controllers": "rtc"}, "controllers is 'rtc'"),
     ({"controllers": [5]}, r"controllers is \[5\]")],
)  # fmt: skip
def test_an_argument_that_would_have_no_effect_is_refused(asked: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        built(**asked)


@pytest.mark.parametrize("more", [{}, {"controllers": ["asynchronous"]}, {"controllers": ["late:delay=1"]}], ids=str)
def test_a_caller_or_a_sink_that_changes_an_action_changes_no_other(more: dict[str, Any]):
    def convert(record: TickRecord) -> None:
        if record.action is not None:
            record.action *= 57

    _, stack, clock = built([0.0, *[99.0] * 9], deadline_ms=10, telemetry=convert, **more)
    played = []
    for step in range(6):
        clock.now = step * 0.05
        action = stack.act({"t": 1})
        played.append(action.tolist())
        action *= 1000
    assert played[0] == [100, 100.5]
    assert {place for place, _ in played} <= {100, 101}, "the rest of the chunk, then a hold"


def test_a_second_policy_with_another_form_of_rotations_is_refused():
    first = spec_of(action=TensorSpec("a", (1, 1, 4), labels=("x", "y", "z", "w"), mode="absolute"))
    turning = Conversion("rotation", parts=((0, 4),), robot="quaternion_xyzw", network="quaternion_wxyz")
    other = spec_of(action=replace(first.action, convert=(turning,)))
    with pytest.raises(UsageError, match="other rotations"):
        build_stack(NumberedPolicy(first), fallback=NumberedPolicy(other))


@pytest.mark.parametrize("more", [{}, {"deadline_ms": 90}, {"deadline_ms": 90, "controllers": ["temporal_ensemble"]}])
def test_the_layers_of_a_stack_say_where_its_time_went(tmp_path: Path, more: dict[str, Any]):
    labels = ("x", "z")
    pose = TensorSpec("x", (1, 2), labels=labels)
    action = TensorSpec("y", (1, 2), labels=labels, mode="absolute")
    path = written(tmp_path / "bundle", "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", (pose,), (action,)).path
    records: list[TickRecord] = []
    stack = load(path, threads=1, seed=0, telemetry=records.append, **more)
    assert isinstance(stack, Stack)
    for _ in range(5):
        stack.act({"x": [1.0, 2.0]}, scheduled=time.monotonic() - 0.001)
    stack.close()
    for each in records:
        parts = dict(zip(PARTS, each.parts_ms, strict=True))
        assert sum(each.parts_ms) + each.waited_ms == pytest.approx(each.answer_ms)
        assert min(parts[name] for name in ("encode", "infer", "decode", "control")) > 0
        assert (parts["handover"] > 0) is ("deadline_ms" in more)
        assert parts["envelope"] == 0
        assert each.waited_ms >= 1


@pytest.mark.parametrize(
    "more",
    [{"deadline_ms": 1000}, {"deadline_ms": 1000, "fallback": NumberedPolicy(spec_of(2, 1, POSITIONS, hz=1))},
     {"controllers": ["rtc:background=true"]}, {"deadline_ms": 1000, "envelope": Stopping}, {"telemetry": [].append}],
)  # fmt: skip
def test_the_threads_of_a_stack_that_nobody_holds_end_without_close(more: dict[str, Any]):
    before = set(threading.enumerate())
    stack = build_stack(NumberedPolicy(spec_of(2, 1, POSITIONS, hz=1)), **more)
    stack.act({"t": 0})
    started = set(threading.enumerate()) - before
    assert started
    gc.disable()  # objects that were frozen for a deadline are never collected
    try:
        del stack
        for thread in started:
            thread.join(10)
    finally:
        gc.enable()
    assert not any(thread.is_alive() for thread in started)
