from __future__ import annotations

import ctypes.util
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from vlatool.errors import UsageError
from vlatool.messages import clouds, pixels
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.worlds import World, open_world

QUIET = {"noise": "0", "pillars": 0}
RENDERS = pytest.mark.skipif(
    not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))),
    reason="neither EGL nor OSMesa is installed: nothing renders",
)


def twist(linear: float, angular: float = 0.0) -> Twist:
    return Twist(Vector3(linear), Vector3(z=angular))


def drive(world: Any, seconds: float, linear: float, angular: float = 0.0) -> list[tuple[str, Any]]:
    """Command a speed ten times a second; return what the world reported."""
    reports = []
    for _ in range(round(seconds * 10)):
        world.obey("/cmd_vel", twist(linear, angular))
        world.advance(0.1)
        reports += world.reports()
    return reports


def newest(reports: list[tuple[str, Any]], topic: str) -> Any:
    return [message for name, message in reports if name == topic][-1]


def test_it_is_a_world_that_drives_by_its_command_and_stops_half_a_second_after_the_last():
    world = open_world("turtlebot4", only="odom", **QUIET)
    assert isinstance(world, World)
    world.reset(1)
    drive(world, 2.0, 0.3)
    assert world.truth()["velocity"] == pytest.approx((0.3, 0.0))
    x, y, yaw = world.truth()["pose"]
    assert math.hypot(x, y) == pytest.approx(0.3 * 2.0 - 0.3**2 / 0.9 / 2, abs=0.01)
    assert math.atan2(y, x) == pytest.approx(yaw, abs=0.01)
    world.advance(0.39)
    assert world.truth()["velocity"][0] == pytest.approx(0.3)
    world.advance(0.11 + 0.3 / 0.9 + 0.02)
    assert world.truth()["velocity"] == pytest.approx((0.0, 0.0))


def test_speeds_are_those_of_the_base_and_a_command_of_nan_is_none():
    world = open_world("turtlebot4", only="odom", **QUIET)
    drive(world, 1.0, 5.0, -9.0)
    assert world.truth()["velocity"] == pytest.approx((0.306, -1.9))
    for _ in range(12):
        world.obey("/cmd_vel", twist(math.nan))
        world.advance(0.1)
    assert world.truth()["velocity"] == pytest.approx((0.0, 0.0))


@RENDERS
def test_the_same_seed_gives_the_same_messages_and_another_another_room():
    first, again, other = ([] for _ in range(3))
    world = open_world("turtlebot4", people=1, movers=1, cliffs=1, drop="0.1", delay="scan=0.2")
    for seed, found in ((3, first), (3, again), (4, other)):
        world.reset(seed)
        found += drive(world, 1.0, 0.2, 0.5)
    scans = [newest(found, "/scan").ranges for found in (first, again, other)]
    images = [newest(found, "/camera/color/image_raw").data for found in (first, again, other)]
    assert [topic for topic, _ in first] == [topic for topic, _ in again]
    assert np.array_equal(scans[0], scans[1])
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(scans[0], scans[2])


@RENDERS
def test_camera_lidar_and_cloud_see_the_same_walls():
    world = open_world("turtlebot4", only="depth,cloud,scan,info,color", **QUIET)
    world.reset(2)
    reports = drive(world, 0.1, 0.0)
    yaw = world.truth()["pose"][2]
    scan = newest(reports, "/scan")
    angles = yaw - math.pi / 2 + scan.angle_increment * np.arange(360)  # turned to the left, 4 cm behind the centre
    place = np.array([-0.04 * math.cos(yaw), -0.04 * math.sin(yaw)])[:, None]
    way = np.stack([np.cos(angles), np.sin(angles)])
    wall = ((2.95 - np.sign(way) * place) / abs(way)).min(axis=0)
    assert scan.ranges == pytest.approx(wall, abs=0.02)
    depth = pixels.depth_m(newest(reports, "/camera/depth/image_raw"))
    assert depth.shape == (120, 160)
    middle = 2.95 / max(abs(math.cos(yaw)), abs(math.sin(yaw)))
    assert depth[55:60, 79:81] == pytest.approx(np.full((5, 2), middle), abs=0.05)
    focal = newest(reports, "/camera/color/camera_info").k[0]
    floor = 0.244 * focal / (119.5 - 60.0)
    assert depth[119] == pytest.approx(np.full(160, floor), abs=0.01)
    points = clouds.points(newest(reports, "/camera/depth/points"))
    assert points[:, 1].max() == pytest.approx(0.244, abs=0.01)
    assert newest(reports, "/camera/color/image_raw").encoding == "rgb8"


def test_odometry_slips_by_the_share_that_is_asked_for():
    errors = []
    for seed in range(6):
        world = open_world("turtlebot4", only="odom", pillars=0, noise="odom=0.05")
        world.reset(seed)
        reports = drive(world, 5.0, 0.3)
        x, y = newest(reports, "/odom").pose.pose.position.x, newest(reports, "/odom").pose.pose.position.y
        errors.append(math.hypot(x, y) / math.hypot(*world.truth()["pose"][:2]) - 1.0)
    assert 0.01 < np.std(errors) < 0.12


@RENDERS
def test_the_target_is_where_the_region_says_and_hidden_when_it_is_taken_away():
    world = open_world("turtlebot4", only="roi,color,depth", **QUIET)
    world.reset(5)
    _, _, yaw = world.truth()["pose"]
    world.place_target(1.2 * math.cos(yaw + 0.2), 1.2 * math.sin(yaw + 0.2))
    reports = drive(world, 0.1, 0.0)
    region, colours = newest(reports, "/roi"), pixels.rgb(newest(reports, "/camera/color/image_raw")).astype(int)
    red = colours[..., 0] - colours[..., 1] > 40
    columns, rows = np.flatnonzero(red.any(axis=0)), np.flatnonzero(red.any(axis=1))
    assert (columns[0], columns[-1] + 1) == pytest.approx((region.x_offset, region.x_offset + region.width), abs=2)
    assert (rows[0], rows[-1] + 1) == pytest.approx((region.y_offset, region.y_offset + region.height), abs=3)
    assert world.truth()["target"] == pytest.approx((1.2, 0.2))
    world.hide_target()
    reports = drive(world, 0.1, 0.0)
    assert newest(reports, "/roi").width == 0
    assert world.truth()["target"] is None


def test_a_target_that_walks_waits_for_the_robot():
    world = open_world("turtlebot4", only="roi", target_m=1.0, target_speed=0.5, **QUIET)
    world.reset(4)
    assert world.truth()["target"] == pytest.approx((1.0, 0.0))
    drive(world, 20.0, 0.0)
    assert world.truth()["target"][0] == pytest.approx(1.5, abs=0.01)


def test_a_collision_counts_once_while_it_drives_and_a_motor_that_pushes_draws_current():
    world = open_world("turtlebot4", only="joints", size_m=2.0, **QUIET)
    world.reset(0)
    reports = drive(world, 6.0, 0.3)
    assert world.truth()["collisions"] == 1
    assert newest(reports, "/joint_states").effort.max() > 4.0
    drive(world, 1.0, 0.0)
    assert world.truth()["collisions"] == 1


@RENDERS
def test_a_pit_is_a_hole_for_the_camera_and_driving_over_it_is_a_fall():
    world = open_world("turtlebot4", only="depth", cliffs=1, **QUIET)
    world.reset(1)
    pit = world._scene.pits[0]
    world._data.qpos[:3] = (pit.left - 0.7, (pit.low + pit.high) / 2, 0.0)
    depth = pixels.depth_m(newest(drive(world, 0.1, 0.0), "/camera/depth/image_raw"))
    focal = 160 / (2 * math.tan(math.radians(34.5)))
    row = round(60 + focal * 0.244 / 0.9)
    assert depth[row, 80] > 1.2
    assert not world.truth()["fell"]
    drive(world, 4.0, 0.3)
    assert world.truth()["fell"]


@pytest.mark.parametrize(
    ("knob", "seen"), [("delay='scan=0.3'", 7), ("drop='scan=1'", 0), ("", 10)], ids=["delay", "drop", "none"]
)
def test_delay_and_drop_hold_messages_back(knob: str, seen: int):
    name, _, value = knob.partition("=")
    world = open_world("turtlebot4", only="scan", **QUIET, **({name: value.strip("'")} if knob else {}))
    world.reset(0)
    assert len(drive(world, 1.0, 0.0)) == seen


def test_a_frozen_sensor_repeats_its_content_with_new_stamps():
    world = open_world("turtlebot4", only="scan", pillars=0, noise="scan=0.01", freeze="scan=0.2")
    world.reset(0)
    scans = [message for _, message in drive(world, 3.0, 0.0)]
    same = [np.array_equal(one.ranges, two.ranges) for one, two in pairwise(scans)]
    stamps = [scan.header.stamp.seconds for scan in scans]
    assert 3 < sum(same) < 29
    assert stamps == sorted(set(stamps))


def test_something_steps_in_and_people_give_way():
    world = open_world("turtlebot4", only="scan,person", people=2, movers=2, intruder_s=1.0, noise="0")
    world.reset(3)
    reports = drive(world, 8.0, 0.0)
    nearest = min(np.nanmin(message.ranges[85:95]) for topic, message in reports if topic == "/scan")
    assert nearest == pytest.approx(0.54, abs=0.02)
    assert world.truth()["collisions"] == 0


@pytest.mark.parametrize(
    "knobs",
    [
        {"only": "radar"}, {"delay": "scan=soon"}, {"drop": "sonar=0.1"}, {"size_m": 1.0}, {"pillars": -1},
        {"noise": "-1"}, {"width": 0}, {"width": 1_000_000}, {"height": -1}, {"battery": math.nan}, {"battery": -1.0},
        {"battery": 90.0}, {"gaps": 5.0}, {"drop": "2"}, {"freeze": "scan=1.5"}, {"pillars": 100_000},
    ],
    ids=str,
)  # fmt: skip
def test_knobs_out_of_range_are_refused(knobs: dict[str, Any]):
    with pytest.raises(UsageError) as caught:
        open_world("turtlebot4", **knobs)
    assert caught.value.fix


def test_another_topic_is_refused():
    world = open_world("turtlebot4", only="odom", **QUIET)
    with pytest.raises(UsageError, match="allowed: Twist on /cmd_vel"):
        world.obey("/cmd", twist(0.1))
