"""Messages of the sensors of a mobile robot, from arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import (
    Point,
    Pose,
    PoseWithCovariance,
    Quaternion,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import CameraInfo, Image, LaserScan, PointCloud2, PointField
from vlatool.messages.std_msgs import Header

Array = NDArray[Any]
FLOAT32 = 7
"""``PointField.FLOAT32``."""


def colour_image(pixels: Array, stamp: Time, frame: str) -> Image:
    """Return an image ``rgb8`` from uint8 (H, W, 3)."""
    rows, columns = pixels.shape[:2]
    data = np.ascontiguousarray(pixels, np.uint8).reshape(-1)
    return Image(Header(stamp, frame), rows, columns, "rgb8", 0, 3 * columns, data)


def depth_image(metres: Array, stamp: Time, frame: str) -> Image:
    """Return an image ``32FC1`` from depths (H, W) in metres."""
    rows, columns = metres.shape
    data = np.ascontiguousarray(metres, "<f4").reshape(-1).view(np.uint8)
    return Image(Header(stamp, frame), rows, columns, "32FC1", 0, 4 * columns, data)


def camera_info(rows: int, columns: int, hfov_rad: float, stamp: Time, frame: str) -> CameraInfo:
    """Return the calibration of a camera without distortion, with square pixels."""
    focal = columns / (2.0 * math.tan(hfov_rad / 2.0))
    k = np.array([focal, 0.0, columns / 2.0, 0.0, focal, rows / 2.0, 0.0, 0.0, 1.0])
    p = np.insert(k.reshape(3, 3), 3, 0.0, axis=1).reshape(-1)
    return CameraInfo(Header(stamp, frame), rows, columns, "plumb_bob", np.zeros(5), k, np.eye(3).reshape(-1), p)


def cloud(points: Array, stamp: Time, frame: str) -> PointCloud2:
    """Return an unordered cloud from points (N, 3) in metres."""
    fields = tuple(PointField(name, 4 * place, FLOAT32, 1) for place, name in enumerate("xyz"))
    data = np.ascontiguousarray(points, "<f4").reshape(-1).view(np.uint8)
    return PointCloud2(Header(stamp, frame), 1, len(points), fields, False, 12, 12 * len(points), data, True)


def scan(ranges: Array, low_m: float, high_m: float, seconds: float, stamp: Time, frame: str) -> LaserScan:
    """Return a scan of a full turn, from -180 degrees on, from ranges (N,) in metres."""
    step = 2.0 * math.pi / len(ranges)
    return LaserScan(
        Header(stamp, frame), -math.pi, math.pi - step, step, 0.0, seconds, low_m, high_m,
        np.asarray(ranges, np.float32),
    )  # fmt: skip


def odometry(pose: tuple[float, float, float], linear: float, angular: float, stamp: Time) -> Odometry:
    """Return odometry of a base at (x, y, yaw), in metres and radians, with its speeds in m/s and rad/s."""
    x, y, yaw = pose
    turn = Quaternion(0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
    return Odometry(
        Header(stamp, "odom"), "base_link", PoseWithCovariance(Pose(Point(x, y, 0.0), turn)),
        TwistWithCovariance(Twist(Vector3(linear, 0.0, 0.0), Vector3(0.0, 0.0, angular))),
    )  # fmt: skip
