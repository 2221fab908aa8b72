"""Planar poses and rectangles in images, for controllers of mobile robots."""

from __future__ import annotations

import math
from typing import NamedTuple

from vlatool.messages.geometry_msgs import Quaternion, Twist, Vector3
from vlatool.messages.nav_msgs import Odometry


class PlanarPose(NamedTuple):
    """A pose on the floor: metres, metres, radians."""

    x: float
    y: float
    yaw: float


def yaw_of(orientation: Quaternion) -> float:
    """Return the rotation about the vertical, in radians, of an orientation; NaN for a quaternion of zeros."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    norm = x * x + y * y + z * z + w * w
    if not norm > 0.0 or not math.isfinite(norm):
        return math.nan
    return math.atan2(2.0 * (w * z + x * y), norm - 2.0 * (y * y + z * z))


def quaternion_of(yaw: float) -> Quaternion:
    """Return the orientation of a rotation about the vertical, in radians."""
    return Quaternion(0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))


def pose_of(odometry: Odometry | None) -> PlanarPose | None:
    """Return the pose that odometry reports; None where there is none, or one of its numbers is not finite."""
    if odometry is None:
        return None
    position = odometry.pose.pose.position
    pose = PlanarPose(position.x, position.y, yaw_of(odometry.pose.pose.orientation))
    return pose if all(map(math.isfinite, pose)) else None


def wrap(angle: float) -> float:
    """Return the same angle in [-pi, pi], in radians."""
    return math.remainder(angle, 2.0 * math.pi)


def clamp(value: float, limit: float) -> float:
    """Return the value, cut to [-limit, limit]; NaN becomes 0."""
    return max(-limit, min(limit, value)) if value == value else 0.0


def twist(linear: float = 0.0, angular: float = 0.0) -> Twist:
    """Return a velocity of a differential drive: m/s forward, rad/s to the left."""
    return Twist(Vector3(linear, 0.0, 0.0), Vector3(0.0, 0.0, angular))
