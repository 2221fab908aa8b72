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
from vlatool.messages.sensor_msgs import CameraInfo, LaserScan
from vlatool.messages.std_msgs import Header

Array = NDArray[Any]


def camera_info(rows: int, columns: int, hfov_rad: float, stamp: Time, frame: str) -> CameraInfo:
    """Return the calibration of a camera without distortion, with square pixels."""
    focal = columns / (2.0 * math.tan(hfov_rad / 2.0))
    k = np.array([focal, 0.0, columns / 2.0, 0.0, focal, rows / 2.0, 0.0, 0.0, 1.0])
    p = np.insert(k.reshape(3, 3), 3, 0.0, axis=1).reshape(-1)
    return CameraInfo(Header(stamp, frame), rows, columns, "plumb_bob", np.zeros(5), k, np.eye(3).reshape(-1), p)


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
