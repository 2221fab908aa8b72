"""Limits of a robot: by name, from a file, with boxes; absurd ones are refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from vlatool.errors import ProfileError
from vlatool.runtime.envelope import Box, JointLimits, RobotLimits, VelocityCurve, robot_names
from vlatool.runtime.envelope.limits import MAX_FILE_BYTES

SLIDE = {"name": "x", "unit": "m", "low": 0.0, "high": 1.0, "velocity": 0.5, "acceleration": 2.0, "jerk": 40.0}


def robot(**changes: Any) -> dict[str, Any]:
    return {"name": "slide", "joints": [{**SLIDE, **changes}]}


def test_robots_are_known_by_name():
    assert {
        "franka-panda",
        "fr3",
        "ur5e",
        "viperx-300",
        "aloha",
        "so-101",
        "turtlebot-4",
        "fetch",
        "px4-quadrotor",
    } <= {*robot_names()}
    panda = RobotLimits.named("franka-panda").joints[3]
    assert (panda.low, panda.high, panda.velocity, panda.acceleration) == (-3.0718, -0.0698, (-2.175, 2.175), 12.5)
    assert len(RobotLimits.named("aloha").joints) == 14
    assert "elbow.acceleration" in RobotLimits.named("ur5e").assumed
    with pytest.raises(ProfileError, match="Unknown robot 'franka-pandas'; did you mean 'franka-panda'"):
        RobotLimits.named("franka-pandas")


def test_a_file_of_the_user(tmp_path: Path):
    path = tmp_path / "slide.json"
    path.write_text(json.dumps(robot()))
    assert RobotLimits.from_json(path).joints[0].velocity == (-0.5, 0.5)
    path.write_text('{"name": "slide", "joints": [], "joints": []}')
    with pytest.raises(ProfileError, match="occurs twice"):
        RobotLimits.from_json(path)
    path.write_bytes(b" " * (MAX_FILE_BYTES + 1))
    with pytest.raises(ProfileError, match="more than"):
        RobotLimits.from_json(path)
    with pytest.raises(ProfileError, match="cannot be read"):
        RobotLimits.from_json(tmp_path)


@pytest.mark.parametrize("change", [
    {"velocity": math.nan}, {"velocity": math.inf}, {"velocity": 0.0}, {"velocity": "fast"}, {"velocity": [0.1, 0.5]},
    {"velocity": True}, {"velocity": [1, 2, 3]}, {"acceleration": -1.0}, {"acceleration": 0.0}, {"jerk": 1e9},
    {"jerk": None}, {"low": 2.0}, {"low": None}, {"high": math.inf}, {"command": "torque"}, {"speed": 1.0},
    {"curve": {"offset": 1.0}}, {"curve": {"offset": 0.1, "slope": -1.0, "low": 0.0, "high": 1.0}}, {"name": ""},
])  # fmt: skip
def test_an_absurd_limit_is_refused(change: dict[str, Any]):
    with pytest.raises(ProfileError):
        RobotLimits.from_dict(robot(**change))


@pytest.mark.parametrize("data", [
    {}, {"name": "slide"}, {"name": "slide", "joints": []}, {"name": "slide", "joints": 3},
    {"name": "slide", "joints": [SLIDE, SLIDE]}, {"name": "slide", "joints": [3]}, {**robot(), "space": "torus"},
    {**robot(), "keep_out": [{"low": {"x": 1}, "high": {"x": 0}}]},
    {**robot(), "keep_out": [{"low": {"x": 0}, "high": {"x": 1}}]},
])  # fmt: skip
def test_a_robot_that_is_none_is_refused(data: dict[str, Any]):
    with pytest.raises(ProfileError):
        RobotLimits.from_dict(data)


def test_a_workspace_bounds_the_axes_that_it_has():
    hand = RobotLimits.named("franka-panda-ee").within(Box({"x": 0.3, "z": 0.0}, {"x": 0.6, "z": 0.5}))
    assert [joint.bounds for joint in hand.joints[:3]] == [(0.3, 0.6), (-math.inf, math.inf), (0.0, 0.5)]
    assert hand.within(Box({"x": 0.0}, {"x": 0.4})).joints[0].bounds == (0.3, 0.4)
    with pytest.raises(ProfileError, match="does not fit 'franka-panda', whose commands are in joint space"):
        RobotLimits.named("franka-panda").outside(Box({"x": 0.0}, {"x": 1.0}))


def test_limits_may_be_slower_in_degrees_in_another_order_and_longer():
    arm = RobotLimits.named("fr3")
    slow = arm.slower(0.25).joints[0]
    gentle = arm.gentler(0.25)
    assert [(joint.velocity, joint.acceleration, joint.jerk) for joint in gentle.joints] == [
        (joint.velocity, 0.25 * joint.acceleration, 0.25 * joint.jerk) for joint in arm.joints
    ]
    assert slow.velocity == (-0.655, 0.655)
    assert slow.high == arm.joints[0].high
    turned = arm.in_degrees().joints[0]
    assert turned.velocity[1] == pytest.approx(math.degrees(2.62))
    assert turned.curve is not None
    assert arm.joints[0].curve is not None
    assert turned.curve.upper(90.0) == pytest.approx(math.degrees(arm.joints[0].curve.upper(math.pi / 2)))
    assert [joint.name for joint in arm.in_order(["joint3", "joint1"]).joints] == ["joint3", "joint1"]
    assert len(arm.plus(JointLimits("gripper", "m", 0.0, 0.08, command="range")).joints) == 8
    for wrong in (0.0, 1.1, math.nan):
        with pytest.raises(ProfileError):
            arm.slower(wrong)
        with pytest.raises(ProfileError):
            arm.gentler(wrong)


def test_the_curve_of_the_fr3_is_that_of_libfranka():
    """``rate_limiting.h``: min(cap, max(0, -0.30 + sqrt(max(0, 12 (2.75010 - q)))))."""
    curve = VelocityCurve(0.30, 12.0, -2.7501, 2.7501)
    assert curve.upper(2.0) == pytest.approx(-0.30 + math.sqrt(12 * 0.7501))
    assert curve.lower(-2.0) == pytest.approx(0.30 - math.sqrt(12 * 0.7501))
    assert curve.upper(2.75) == 0 == curve.upper(3.0)
