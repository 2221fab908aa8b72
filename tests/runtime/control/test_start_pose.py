"""The way back to the start pose, in a world that moves as it is commanded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, UsageError
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.start_pose import StartPose
from vlatool.runtime.interface import Controller

PLACE = TensorSpec("place", (1, 2), labels=("x", "y"))
HZ = 10.0


def spec(mode: str) -> PolicySpec:
    action = replace(MOVES, mode=mode, labels=("x", "y"))
    return PolicySpec((*spec_of().inputs, PLACE), (action,), HZ, 2)


def in_units(mode: str, place: Any, move: Any) -> PolicySpec:
    number, state = spec(mode).inputs
    action = replace(spec(mode).action, unit=move)
    return replace(spec(mode), inputs=(number, replace(state, unit=place)), outputs=(action,))


class World:
    """A robot that moves by what it is commanded, in the way of a mode."""

    def __init__(self, mode: str, place: list[float]) -> None:
        self.mode, self.place, self.steps = mode, np.array(place), 0
        self.free = True

    def step(self, controller: Controller) -> np.ndarray[Any, Any]:
        action = controller.act({"t": self.steps, "place": self.place})
        self.steps += 1
        if self.free:
            rate = 1 / HZ if self.mode == "velocity" else 1.0
            self.place = action.copy() if self.mode == "absolute" else self.place + action * rate
        return action


def acting(mode: str, **options: Any) -> tuple[Controller, NumberedPolicy]:
    policy = NumberedPolicy(spec(mode))
    return StartPose(build_controller(policy), spec=policy.spec, **options), policy


@pytest.mark.parametrize("mode", ["delta", "velocity", "absolute"])
def test_the_robot_is_at_the_pose_when_the_policy_is_asked(mode: str):
    controller, policy = acting(mode, pose=[1.0, -2.0], seconds=1.5, tolerance=1e-3)
    world = World(mode, [0.4, 0.0])
    places = []
    for _ in range(15):
        world.step(controller)
        places.append(world.place)
        assert not controller.fresh
    np.testing.assert_allclose(world.place, [1, -2], atol=1e-5)
    assert policy.asked == []
    assert np.abs(np.diff(places, axis=0)).max() < 2 * 1.9 / 15, "the fastest step of a way with least jerk"
    world.step(controller)
    assert policy.asked == [15]
    assert controller.fresh


def test_without_a_pose_later_episodes_begin_where_the_first_one_did():
    controller, policy = acting("delta")
    world = World("delta", [0.5, 0.5])
    np.testing.assert_array_equal(world.step(controller), [0, 0.5])
    world.place = np.array([3.0, 1.0])
    controller.reset(8)
    for _ in range(20):
        world.step(controller)
    np.testing.assert_allclose(world.place, [0.5, 0.5], atol=1e-5)
    world.step(controller)
    assert (policy.asked, policy.seeds) == ([0, 21], [8])


def test_a_robot_that_does_not_arrive_is_an_error():
    controller, policy = acting("absolute", pose=[1.0, 1.0], seconds=0.5, tolerance=0.1)
    world = World("absolute", [0.0, 0.0])
    world.free = False
    for _ in range(11):
        world.step(controller)
    with pytest.raises(DataError, match="The robot is 1 away from its start pose after 2 times"):
        world.step(controller)
    assert policy.asked == []


@pytest.mark.parametrize(
    ("arguments", "of", "message"),
    [({"pose": [1.0]}, spec("delta"), r"The pose has the shape \[1\]"), ({"seconds": 0}, spec("delta"), "seconds is 0"),
     ({"pose": [1.0, float("nan")]}, spec("delta"), "finite numbers"), ({"state": "t"}, spec("delta"), "0 inputs"),
     ({}, spec_of(), "0 inputs have the 2 elements of 'a'"), ({}, spec("relative"), "of the mode 'relative'"),
     ({"tolerance": -1.0}, spec("delta"), "tolerance is -1.0")],
)  # fmt: skip
def test_what_does_not_fit_is_refused(arguments: dict[str, Any], of: PolicySpec, message: str):
    with pytest.raises(UsageError, match=message):
        StartPose(build_controller(NumberedPolicy(of)), spec=of, **arguments)


@pytest.mark.parametrize(
    ("mode", "place", "move", "wanted"),
    [("absolute", "deg", "rad", "deg"), ("delta", "mm", "m", "mm"), ("velocity", "m", "m", "m/s"),
     ("velocity", "m", "mm/s", "m/s"), ("absolute", ("m", "rad"), ("m", "deg"), "rad"), ("delta", "m", "m/s", "m")],
)  # fmt: skip
def test_a_state_in_other_units_than_the_action_is_refused(mode: str, place: Any, move: Any, wanted: str):
    one = in_units(mode, place, move)
    with pytest.raises(UsageError, match=f"wanted: {wanted}"):
        StartPose(build_controller(NumberedPolicy(one)), spec=one)


@pytest.mark.parametrize(
    ("mode", "place", "move"),
    [("absolute", "m", "m"), ("velocity", "m", "m/s"), ("delta", "", "m"), ("velocity", "rad", "")],
)
def test_units_that_agree_or_are_not_stated_are_taken(mode: str, place: str, move: str):
    one = in_units(mode, place, move)
    assert StartPose(build_controller(NumberedPolicy(one)), spec=one).moving


def test_an_observation_without_the_position_is_refused():
    controller, _ = acting("delta")
    with pytest.raises(DataError, match="has no 'place'"):
        controller.act({"t": 0})


@pytest.mark.parametrize("mode", ["delta", "velocity", "absolute"])
def test_a_position_that_is_not_finite_is_no_place_to_start_from(mode: str):
    for pose, broken in ((None, np.nan), ([1.0, -2.0], np.inf)):
        controller, policy = acting(mode, pose=pose)
        with pytest.raises(DataError, match="'place' is not finite"):
            controller.act({"t": 0, "place": np.array([0.0, broken])})
        assert not policy.asked
