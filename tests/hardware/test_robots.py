"""Limits of robots with their sources: what is shipped to a robot is what the profiles say."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.errors import ProfileError
from vlatool.hardware.robots import load_robot, robot_folder, robots, robots_json, robots_page
from vlatool.runtime.envelope import RobotLimits, robot_names
from vlatool.runtime.envelope.limits import ROBOTS


def test_the_robots_json_is_that_of_the_profiles():
    assert ROBOTS.read_text(encoding="utf-8") == robots_json(), "run: make docs"
    assert robot_names() == [robot.name for robot in robots()]


@pytest.mark.parametrize("name", robot_names())
def test_each_robot_has_limits_and_says_which_are_assumed(name: str):
    limits = RobotLimits.named(name)
    (robot,) = (each for each in robots() if each.name == name)
    assumed = [row for part in robot.parts for row in part.rows().values() if row.assumed]
    assert bool(assumed) == bool(limits.assumed)
    joints = {joint.name for joint in limits.joints}
    assert {each.partition(".")[0] for each in limits.assumed} <= joints
    assert name in robots_page()


@pytest.mark.parametrize(("old", "new", "message"), [
    ("velocity: {values: [2.175", "velocity: {values: [fast", "valid"),
    ("jerk: {values: [7500.0, ", "jerk: {values: [", "jerk: has 6 values for 7 joints"),
    ("source: fer", "source: nobody", "the source 'nobody' is not in sources"),
    ("space: joint", "space: joint\nspeed: 3", "speed: is not a known key"),
    ("source: fer}", "source: fer, assumed: true}", "an assumption needs a note"),
])  # fmt: skip
def test_a_malformed_robot_is_refused(tmp_path: Path, old: str, new: str, message: str):
    text = (robot_folder() / "franka-panda.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "robot.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ProfileError, match=message):
        load_robot(path)
