"""Sensors of the simulated TurtleBot 4: when each measures, and what it says."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.clouds import points_message
from vlatool.messages.geometry_msgs import Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.pixels import image_message
from vlatool.messages.sensor_msgs import (
    BatteryState,
    CameraInfo,
    Image,
    Imu,
    JointState,
    LaserScan,
    PointCloud2,
    RegionOfInterest,
)
from vlatool.messages.std_msgs import Bool, Header
from vlatool.worlds import _mobile_messages as build
from vlatool.worlds._differential_drive import DifferentialDrive
from vlatool.worlds._faults import Outbox
from vlatool.worlds._interface import Channel
from vlatool.worlds._rendering import Camera

Array = NDArray[Any]
SENSORS = {
    "color": Channel("/camera/color/image_raw", Image, 10.0),
    "info": Channel("/camera/color/camera_info", CameraInfo, 10.0),
    "depth": Channel("/camera/depth/image_raw", Image, 10.0),
    "cloud": Channel("/camera/depth/points", PointCloud2, 10.0),
    "roi": Channel("/roi", RegionOfInterest, 10.0),
    "scan": Channel("/scan", LaserScan, 10.0),
    "imu": Channel("/imu", Imu, 50.0),
    "odom": Channel("/odom", Odometry, 20.0),
    "joints": Channel("/joint_states", JointState, 20.0),
    "battery": Channel("/battery_state", BatteryState, 1.0),
    "person": Channel("/person_in_workspace", Bool, 10.0),
}
"""Sensor -> its topic. ``roi`` is a detector of the red target that never errs, ``person`` one of people."""
CAMERA_HEIGHT_M = 0.244
"""Height of the OAK-D of a TurtleBot 4 above the floor."""
HFOV_RAD = math.radians(69.0)
"""Horizontal field of view of an OAK-D's colour camera."""
FAR_M = 8.0
"""Distance from which the depth camera sees nothing."""
LIDAR_HEIGHT_M, LIDAR_RAYS, LIDAR_NEAR_M, LIDAR_FAR_M = 0.19, 360, 0.15, 12.0
"""An RPLIDAR A1: one ray for a degree."""
LIDAR_YAW, LIDAR_FORWARD_M = math.pi / 2.0, -0.04
"""Where it is on the base, in radians and metres (turtlebot4_description): its 0 degrees are to the left."""
TICKS = 100.0
"""Ticks of the simulation in a second."""
IDLE_SHARE, DRIVE_SHARE = 5e-5, 5e-5
"""Charge that a second takes, and a second at full speed on top: some four hours."""
CLOUD_STRIDE = 2


class Sensors:
    """What the robot measures, and when.

    Args:
        names: Sensors that are simulated, of ``SENSORS``.
        size: (H, W) of the camera.
        noise: Sensor -> standard deviation; see ``TurtleBot4``.
        gaps: Share of the lidar's turn without ranges.
        outbox: Where messages go.
        battery: Charge, from 0 to 1.
    """

    def __init__(
        self, mujoco: Any, model: Any, names: tuple[str, ...], size: tuple[int, int], noise: Mapping[str, float],
        gaps: float, outbox: Outbox, random: np.random.Generator, battery: float,
    ) -> None:  # fmt: skip
        self._mujoco, self._model, self._names, self._size = mujoco, model, names, size
        self._noise, self._gaps, self.outbox, self._random = noise, gaps, outbox, random
        self._battery, self._last_linear = battery, 0.0
        self._base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "base")
        cameras = {"color", "depth", "cloud"} & set(names)
        self._camera = Camera(mujoco, model, "front", *size) if cameras else None
        self._angles = -math.pi + 2.0 * math.pi / LIDAR_RAYS * np.arange(LIDAR_RAYS)
        self._hits, self._distances = np.zeros(LIDAR_RAYS, np.int32), np.zeros(LIDAR_RAYS)

    def close(self) -> None:
        """Give back what the camera holds."""
        if self._camera is not None:
            self._camera.close()

    def sense(
        self, tick: int, data: Any, drive: DifferentialDrive, target: tuple[float, float] | None, person: bool,
        contact: bool,
    ) -> None:  # fmt: skip
        """Send what is due at a tick."""
        self._battery = max(0.0, self._battery - (IDLE_SHARE + DRIVE_SHARE * abs(drive.linear) / 0.306) / TICKS)
        acceleration, self._last_linear = (drive.linear - self._last_linear) * TICKS, drive.linear
        due = [name for name in self._names if tick % round(TICKS / SENSORS[name].rate_hz) == 0]
        if not due:
            return
        stamp, depth = Time.from_seconds(tick / TICKS), None
        if self._camera is not None and {"depth", "cloud"} & set(due):
            depth = self._depth(self._camera, data)
        for name in due:
            message = self._message(name, stamp, data, drive, target, person, contact, depth, acceleration)
            if message is not None:
                self.outbox.put(name, SENSORS[name].topic, message, tick / TICKS)

    def _message(
        self, name: str, stamp: Time, data: Any, drive: DifferentialDrive, target: tuple[float, float] | None,
        person: bool, contact: bool, depth: Array | None, acceleration: float,
    ) -> Message | None:  # fmt: skip
        rows, columns = self._size
        optical = "camera_color_optical_frame"
        if name == "color" and self._camera is not None:
            return image_message(self._colours(self._camera, data), "rgb8", Header(stamp, optical))
        if name == "depth" and depth is not None:
            return image_message(depth, "32FC1", Header(stamp, optical))
        if name == "cloud" and depth is not None:
            return points_message(points_of(depth), Header(stamp, optical))
        if name == "info":
            return build.camera_info(rows, columns, HFOV_RAD, stamp, optical)
        if name == "roi":
            return region_of(target, data.qpos[:3], rows, columns)
        if name == "scan":
            return self._scan(stamp, data)
        if name == "odom":
            return build.odometry(drive.odometry, drive.linear, drive.angular, stamp)
        if name == "imu":
            return self._imu(stamp, drive, acceleration)
        if name == "joints":
            return self._joints(stamp, drive, contact, acceleration)
        if name == "battery":
            return BatteryState(Header(stamp, "base_link"), 14.4, percentage=self._battery, present=True)
        return Bool(person)

    def _deviation(self, name: str, shape: Any) -> Array:
        return np.asarray(self._random.normal(0.0, self._noise.get(name, 0.0), shape))

    def _colours(self, camera: Camera, data: Any) -> Array:
        pixels = camera.colours(data)
        noisy = pixels + self._deviation("color", pixels.shape[:2])[..., None]
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)

    def _depth(self, camera: Camera, data: Any) -> Array:
        depth = camera.depth(data)
        depth *= 1.0 + self._deviation("depth", depth.shape).astype(np.float32)
        depth[depth > FAR_M] = np.nan
        return depth

    def _scan(self, stamp: Time, data: Any) -> LaserScan:
        x, y, yaw = data.qpos[:3]
        angles = self._angles + LIDAR_YAW + yaw
        rays = np.stack([np.cos(angles), np.sin(angles), np.zeros(LIDAR_RAYS)], axis=1).reshape(-1)
        lidar = x + LIDAR_FORWARD_M * math.cos(yaw), y + LIDAR_FORWARD_M * math.sin(yaw)
        origin = np.array([*lidar, LIDAR_HEIGHT_M])
        self._mujoco.mj_multiRay(
            self._model, data, origin, rays, None, 1, self._base, self._hits, self._distances, LIDAR_RAYS, LIDAR_FAR_M
        )
        ranges = np.where(self._distances < 0.0, np.inf, self._distances + self._deviation("scan", LIDAR_RAYS))
        if self._gaps:
            length, first = round(self._gaps * LIDAR_RAYS), int(self._random.integers(LIDAR_RAYS))
            ranges[(first + np.arange(length)) % LIDAR_RAYS] = np.nan
        return build.scan(ranges, LIDAR_NEAR_M, LIDAR_FAR_M, 0.1, stamp, "rplidar_link")

    def _imu(self, stamp: Time, drive: DifferentialDrive, acceleration: float) -> Imu:
        noise = self._deviation("imu", 6)
        turn = Vector3(noise[0], noise[1], drive.angular + noise[2])
        push = Vector3(acceleration + noise[3], drive.linear * drive.angular + noise[4], 9.81 + noise[5])
        return Imu(Header(stamp, "imu_link"), angular_velocity=turn, linear_acceleration=push)

    def _joints(self, stamp: Time, drive: DifferentialDrive, contact: bool, acceleration: float) -> JointState:
        """Return the wheels: speeds in rad/s, currents in amperes as efforts; a wheel that pushes draws more."""
        base, radius = 0.233, 0.036  # metres between the wheels of a Create 3, and of their radius
        speeds = np.array([drive.linear - drive.angular * base / 2.0, drive.linear + drive.angular * base / 2.0])
        pushes = contact and abs(drive.linear) > 0.01
        currents = np.asarray(0.1 + 0.5 * abs(speeds) + 0.5 * abs(acceleration) + (4.0 if pushes else 0.0), np.float64)
        names = ("left_wheel_joint", "right_wheel_joint")
        return JointState(Header(stamp, "base_link"), names, np.zeros(2), speeds / radius, currents)


def points_of(depth: Array) -> Array:
    """Return the points (N, 3) of a depth image in the optical frame, in metres, every second row and column."""
    rows, columns = depth.shape
    focal = columns / (2.0 * math.tan(HFOV_RAD / 2.0))
    part = depth[::CLOUD_STRIDE, ::CLOUD_STRIDE]
    right = (np.arange(0, columns, CLOUD_STRIDE) + 0.5 - columns / 2.0) / focal
    down = (np.arange(0, rows, CLOUD_STRIDE) + 0.5 - rows / 2.0) / focal
    points = np.stack([part * right[None, :], part * down[:, None], part], axis=-1).reshape(-1, 3)
    return np.asarray(points[np.isfinite(points[:, 2])], np.float32)


def region_of(
    target: tuple[float, float] | None, pose: Any, rows: int, columns: int, radius: float = 0.12, top: float = 0.6
) -> RegionOfInterest:
    """Return where the camera sees an upright cylinder; a region without size where it does not."""
    if target is None:
        return RegionOfInterest()
    dx, dy = target[0] - pose[0], target[1] - pose[1]
    distance = math.hypot(dx, dy)
    bearing = math.remainder(math.atan2(dy, dx) - pose[2], 2.0 * math.pi)
    if distance < 2.0 * radius or abs(bearing) > HFOV_RAD / 2.0:
        return RegionOfInterest()
    focal = columns / (2.0 * math.tan(HFOV_RAD / 2.0))
    half, ahead = math.asin(radius / distance), distance * math.cos(bearing) - radius
    left = columns / 2.0 - focal * math.tan(bearing + half)
    right = columns / 2.0 - focal * math.tan(bearing - half)
    upper = rows / 2.0 - focal * (top - CAMERA_HEIGHT_M) / ahead
    lower = rows / 2.0 + focal * CAMERA_HEIGHT_M / (ahead + radius)
    x, y = max(0, round(left)), max(0, round(upper))
    width, height = min(columns, round(right)) - x, min(rows, round(lower)) - y
    return (
        RegionOfInterest(x_offset=x, y_offset=y, width=width, height=height)
        if min(width, height) > 2
        else (RegionOfInterest())
    )
