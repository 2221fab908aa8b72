"""Anomaly monitors: each finds its fault, keeps quiet at what is usual, and stops the robot only if asked to."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from _numbered import EchoController, NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import AnomalyAlarm, DeadlineMissed, UsageError
from vlatool.runtime.anomaly import (
    WINDOW,
    AnomalyMonitor,
    Entropy,
    InputShift,
    Reversals,
    Scale,
    Stall,
    Step,
    ZScore,
    monitors_of,
    relative_entropy,
)
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.anomaly import Anomaly
from vlatool.runtime.interface import Controller
from vlatool.runtime.stack import Fallback, build_stack

MOVES = TensorSpec("a", (1, 1, 3), labels=("x", "y", "gripper"), mode="delta")
POSES = replace(MOVES, mode="absolute")
WORDS = TensorSpec("a", (1, 3), kind="discrete", labels=("left", "right", "forward"))


def scores(monitor: AnomalyMonitor, actions: Any, **more: Any) -> list[float | None]:
    """Return the scores of actions, ten of which come in a second."""
    return [monitor.score(Step({}, np.ravel(np.asarray(each, float)).tolist(), None, number / 10, **more))
            for number, each in enumerate(actions)]  # fmt: skip


def test_a_z_score_is_that_of_the_farthest_element():
    monitor = ZScore(8.0, Scale([0.0, 10.0, 1.0], [1.0, 2.0, 0.5]))
    assert scores(monitor, [[0, 10, 1], [3, 10, 1], [0, 2, 1], [0, 10, 6]]) == [0, 3, 4, 10]


def wave(period: int, count: int = 60, noise: float = 0.0) -> Any:
    random = np.random.default_rng(0)
    times = np.arange(count)
    return np.stack([np.sin(2 * np.pi * times / period), 0.5 + 0 * times, times % 2], 1) + random.normal(
        0, noise, (count, 3)
    )


@pytest.mark.parametrize("action", [MOVES, POSES], ids=["delta", "absolute"])
def test_turns_are_counted_of_motion_and_not_of_noise_or_a_gripper(action: TensorSpec):
    shaken = np.where(np.arange(60) % 2, 1.0, -1.0)[:, None] * [1.0, 0.0, 0.0]
    assert scores(Reversals(0.7, action), shaken)[-1] == 1.0
    assert (scores(Reversals(0.7, action), wave(20))[-1] or 0) <= 0.15
    steady = np.cumsum(np.full((60, 3), 0.1), 0) + np.random.default_rng(1).normal(0, 0.001, (60, 3))
    assert (scores(Reversals(0.7, action), steady if action is POSES else steady * 0 + 0.1)[-1] or 0) <= 0.1
    assert scores(Reversals(0.7, action), shaken)[: WINDOW - 1] == [None] * (WINDOW - 1)
    monitor = Reversals(0.7, action)
    scores(monitor, shaken)
    monitor.reset()
    assert scores(monitor, wave(20))[: WINDOW - 1] == [None] * (WINDOW - 1)


def test_of_discrete_actions_those_that_come_again_after_another_are_counted():
    assert scores(Reversals(0.7, WORDS), [0, 1] * 20)[-1] == 1.0
    assert scores(Reversals(0.7, WORDS), [2] * 40)[-1] == 0.0
    assert scores(Reversals(0.7, WORDS), [0, 0, 1, 1, 2, 2] * 7)[-1] == 0.0


def at_rest(gripper: float, count: int = 150) -> Any:
    return np.tile([0.0, 0.0, gripper], (count, 1))


@pytest.mark.parametrize(("closed", "gripper", "alarm"), [("high", 1, True), ("high", -1, False), ("low", -1, True),
                                                          ("low", 1, False), ("any", -1, True)])  # fmt: skip
def test_a_closed_gripper_without_a_motion_stalls_after_ten_seconds(closed: str, gripper: float, alarm: bool):
    for action in (MOVES, POSES):
        found = scores(Stall(10.0, action, None, closed), at_rest(gripper))
        assert (max(each or 0.0 for each in found) > 10) is alarm
        assert max(each or 0.0 for each in found[:100]) <= 10
    moving = at_rest(gripper)
    moving[::50, 0] = 0.5
    assert max(each or 0.0 for each in scores(Stall(10.0, MOVES, None, closed), moving)) < 6
    opening = at_rest(gripper)
    opening[100:, 2] += np.arange(50)
    assert (scores(Stall(10.0, MOVES, None, closed), opening)[-1] or 0.0) < 0.1


def test_the_recent_mean_of_an_input_is_compared_with_its_statistics():
    random = np.random.default_rng(0)
    monitor = InputShift(4.0, {"state": Scale([1.0, 2.0], [0.5, 0.1])})

    def shown(offset: float, count: int) -> list[float | None]:
        rows = random.normal([1.0, 2.0 + offset], [0.5, 0.1], (count, 2))
        return [monitor.score(Step({"state": row[None]}, [0.0], None, 0.0)) for row in rows]

    usual = shown(0.0, 300)
    assert usual[: WINDOW - 1] == [None] * (WINDOW - 1)
    assert max(each or 0 for each in usual) < 1.5
    assert (shown(0.8, 200)[-1] or 0) > 4
    monitor.reset()
    assert (shown(0.0, 60)[-1] or 0) < 1.5


def test_the_entropy_of_logits_is_that_of_a_uniform_draw_at_most():
    assert relative_entropy(np.zeros((1, 5))) == pytest.approx(1.0)
    assert relative_entropy(np.array([[0.0, 1000.0, -1000.0]])) == pytest.approx(0.0)
    assert relative_entropy(np.log(np.array([[[0.5, 0.5, 1e-9]]]))) == pytest.approx(np.log(2) / np.log(3), abs=1e-6)
    monitor = Entropy(0.95, "a")
    logits = [{"a": np.zeros((1, 3))}, None, *[{"a": np.zeros((1, 3))}] * 4]
    found = [monitor.score(Step({}, [0.0], outputs, 0.0)) for outputs in logits]
    assert found == [None, None, None, None, None, pytest.approx(1.0)]


LIMITS = {"z_score": 1.0, "reversals": 1.0, "stall": 1.0, "input_shift": 1.0, "entropy": 1.0}


@pytest.mark.parametrize(
    ("action", "names"),
    [(MOVES, ["reversals", "stall"]), (WORDS, ["reversals", "entropy"]),
     (replace(MOVES, labels=("x", "y", "z")), ["reversals"])],
)  # fmt: skip
def test_what_a_bundle_does_not_say_is_not_watched(action: TensorSpec, names: list[str]):
    spec = PolicySpec((TensorSpec("state", (1, 2)),), (action,), 10.0)
    assert [each.name for each in monitors_of(spec, None, LIMITS, "any")] == names
    assert [each.name for each in monitors_of(spec, None, {**LIMITS, names[0]: 0.0}, "any")] == names[1:]


def test_actions_pass_unchanged_and_alarms_are_in_the_records():
    records: list[Any] = []
    stack = build_stack(NumberedPolicy(spec_of(1, action=TensorSpec("a", (1, 1, 2), labels=("x", "z"), mode="delta"))),
                        controllers=["anomaly:reversals=0.5"], telemetry=records.append)  # fmt: skip
    assert isinstance(stack.controller, Controller)
    for step in range(40):
        sign = 1 if step < 10 or step % 2 else -1
        assert stack.act({"t": sign * 3}).tolist() == [sign * 300, sign * 300 + 0.5]
    stack.close()
    assert [record.alarms for record in records[:20]] == [()] * 20
    assert records[-1].alarms == ("reversals",)
    stack.reset()
    assert stack.controller.alarms == ()


class Stopping:
    """An envelope that knows how to stop."""

    def __init__(self, controller: Any) -> None:
        self.controller = controller

    fresh = property(lambda self: self.controller.fresh)

    def act(self, observation: Any) -> Any:
        return self.controller.act(observation)

    def stop(self) -> Any:
        return np.zeros(2, np.float32)

    def reset(self, seed: int | None = None) -> None:
        self.controller.reset(seed)


def test_alarms_that_last_stop_the_robot_where_that_is_asked_for():
    spec = spec_of(1, action=TensorSpec("a", (1, 1, 2), labels=("x", "z"), mode="delta"))
    stack = build_stack(NumberedPolicy(spec), controllers=["anomaly:reversals=0.5:escalate=true:after=4"],
                        fallback=Fallback(), envelope=Stopping)  # fmt: skip
    actions = [float(stack.act({"t": step % 2 * 2 - 1})[0]) for step in range(40)]
    first = actions.index(0.0)
    assert WINDOW <= first < WINDOW + 6
    assert actions[first:] == [0.0] * (40 - first)
    assert stack.origin.source == "stop"
    calm = [float(stack.act({"t": 1})[0]) for _ in range(30)]
    assert calm[-1] == 100.0, "it goes on when the alarm is over"
    alone = build_controller(NumberedPolicy(spec), ["anomaly:reversals=0.5:escalate=true"])
    with pytest.raises(AnomalyAlarm, match=r"The monitor reversals has .*; its limit is 0\.5"):
        [alone.act({"t": step % 2 * 2 - 1}) for step in range(40)]


def test_what_cannot_be_judged_is_an_alarm_and_no_reason_to_have_no_action():
    class Broken(AnomalyMonitor):
        name = "broken"

        def score(self, step: Step) -> float:
            raise KeyError("state")

    class Nan(AnomalyMonitor):
        name = "nan"

        def score(self, step: Step) -> float:
            return float("nan")

    controller = Anomaly(EchoController("a"), spec=spec_of())
    controller.monitors += [Broken(5.0), Nan(5.0)]
    assert controller.act({"a": [1.0, 2.0]}).tolist() == [1.0, 2.0]
    assert controller.alarms == ("broken", "nan")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"z_score": -1.0}, "z_score is -1"), ({"stall": float("nan")}, "stall is nan"), ({"after": 0}, "after is 0"),
     ({"closed": "tight"}, "closed is 'tight'"), ({"spread": float("inf")}, "spread is inf")],
)  # fmt: skip
def test_an_option_out_of_its_range_is_refused(wrong: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        Anomaly(EchoController("a"), spec=spec_of(), **wrong)


def test_errors_of_the_controller_pass_and_leave_no_alarm_behind():
    def fail(observation: Any) -> Any:
        raise DeadlineMissed("late")

    inside: Any = SimpleNamespace(act=fail, fresh=False, reset=lambda seed: None)
    controller = Anomaly(inside, spec=spec_of())
    with pytest.raises(DeadlineMissed):
        controller.act({})
    assert controller.alarms == ()
