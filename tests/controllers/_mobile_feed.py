"""Snapshots and messages of sensors for tests of controllers."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlatool.controllers import Reading, Snapshot
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.pixels import image_message
from vlatool.messages.sensor_msgs import CameraInfo, Image
from vlatool.messages.std_msgs import Header
from vlatool.worlds import _mobile_messages as mobile_messages


class Feed:
    """Builds the snapshots of a run: what came last stays the newest."""

    def __init__(self) -> None:
        self.newest: dict[str, Reading] = {}

    def snapshot(
        self, time_s: float, stamp_s: float | None = None, requests: Any = (), **messages: Message
    ) -> Snapshot:
        for name, message in messages.items():
            count = self.newest[name].sequence + 1 if name in self.newest else 0
            self.newest[name] = Reading(message, time_s, count)
        readings = {name: (self.newest[name],) for name in messages}
        stamp = Time.from_seconds(time_s if stamp_s is None else stamp_s)
        return Snapshot(time_s, stamp, readings, dict(self.newest), tuple(requests))


def header(stamp_s: float) -> Header:
    return Header(Time.from_seconds(stamp_s))


def camera_info(width: int = 64, height: int = 48) -> CameraInfo:
    return CameraInfo(width=width, height=height)


def depth_image(metres: np.ndarray, stamp_s: float = 0.0) -> Image:
    return image_message(metres.astype(np.float32), "32FC1", header(stamp_s))


def odometry(
    x: float, y: float, yaw: float, stamp_s: float = 0.0, linear: float = 0.0, angular: float = 0.0
) -> Odometry:
    return mobile_messages.odometry((x, y, yaw), linear, angular, Time.from_seconds(stamp_s))


def velocity(linear: float, angular: float = 0.0) -> Twist:
    return Twist(Vector3(linear), Vector3(z=angular))


def speeds(command: Any, output: str = "cmd_vel") -> tuple[float, float]:
    (message,) = command.messages[output]
    return message.linear.x, message.angular.z
