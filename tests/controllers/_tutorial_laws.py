"""The laws of the followers of "ROS by Example", written down from the book's descriptions, message by message.

Plain Python: loops over pixels and points, running speeds, integer halves as Python 2 had them.
"""

from __future__ import annotations

import math

import numpy as np


def turn(x_offset: int, width: int, image_width: int, gain: float, threshold: float, low: float, high: float) -> float:
    """Rotation speed for a region: none near the centre, else proportional, between two limits."""
    target_offset = x_offset + int(width / 2) - int(image_width / 2)
    percent = float(target_offset) / (float(image_width) / 2.0)
    if abs(percent) <= threshold:
        return 0.0
    speed = min(abs(gain * percent), high)
    if speed < low:
        speed = low
    return -speed if percent > 0 else speed


class ObjectFollower:
    """Keeps the distance of a region; remembers its speed forward."""

    def __init__(self, **changes: float) -> None:
        self.settings = {
            "scale_roi": 0.9, "x_threshold": 0.1, "x_scale": 2.0, "z_threshold": 0.05, "z_scale": 0.5, "goal_z": 0.75,
            "min_z": 0.5, "max_z": 1.6, "min_linear_speed": 0.02, "max_linear_speed": 0.3, "min_rotation_speed": 0.5,
            "max_rotation_speed": 2.0, "slow_down_factor": 0.8, **changes,
        }  # fmt: skip
        self.linear = self.angular = 0.0

    def lost(self) -> tuple[float, float]:
        self.linear *= self.settings["slow_down_factor"]
        self.angular *= self.settings["slow_down_factor"]
        return self.linear, self.angular

    def seen(self, region: tuple[int, int, int, int], depth: np.ndarray, image_width: int) -> tuple[float, float]:
        s = self.settings
        x, y, width, height = region
        self.angular = turn(
            x, width, image_width, s["x_scale"], s["x_threshold"], s["min_rotation_speed"], s["max_rotation_speed"]
        )
        total, count = 0.0, 0
        left, top = int(x + width * (1.0 - s["scale_roi"]) / 2.0), int(y + height * (1.0 - s["scale_roi"]) / 2.0)
        for column in range(left, left + int(width * s["scale_roi"])):
            for row in range(top, top + int(height * s["scale_roi"])):
                z = float(depth[row, column])
                if math.isnan(z) or z > s["max_z"]:
                    continue
                total, count = total + z, count + 1
        wanted = 0.0
        if count:
            mean = max(s["min_z"], total / count)
            if s["min_z"] < mean < s["max_z"] and abs(mean - s["goal_z"]) > s["z_threshold"]:
                speed = (mean - s["goal_z"]) * s["z_scale"]
                size = min(s["max_linear_speed"], max(s["min_linear_speed"], abs(speed)))
                wanted = math.copysign(size, speed)
        self.linear = wanted if wanted else self.linear * s["slow_down_factor"]
        return self.linear, self.angular


class CloudFollower:
    """Keeps the distance of the points in a box; remembers both speeds."""

    def __init__(self, **changes: float) -> None:
        self.settings = {
            "min_x": -0.2, "max_x": 0.2, "min_y": -0.2, "max_y": 0.5, "max_z": 1.2, "goal_z": 0.6, "z_threshold": 0.05,
            "x_threshold": 0.05, "z_scale": 1.0, "x_scale": 2.5, "min_linear_speed": 0.1, "max_linear_speed": 0.3,
            "min_angular_speed": 0.0, "max_angular_speed": 2.0, "slow_down_factor": 0.8, **changes,
        }  # fmt: skip
        self.linear = self.angular = 0.0

    def seen(self, points: np.ndarray) -> tuple[float, float]:
        s = self.settings
        x = z = 0.0
        n = 0
        for px, py, pz in points.tolist():
            if math.isnan(px) or math.isnan(py) or math.isnan(pz):
                continue
            if s["min_y"] < -py < s["max_y"] and s["min_x"] < px < s["max_x"] and pz < s["max_z"]:
                x, z, n = x + px, z + pz, n + 1
        if n == 0:
            self.linear *= s["slow_down_factor"]
            self.angular *= s["slow_down_factor"]
            return self.linear, self.angular
        x, z = x / n, z / n
        if abs(z - s["goal_z"]) > s["z_threshold"]:
            speed = (z - s["goal_z"]) * s["z_scale"]
            self.linear = math.copysign(max(s["min_linear_speed"], min(s["max_linear_speed"], abs(speed))), speed)
        else:
            self.linear *= s["slow_down_factor"]
        if abs(x) > s["x_threshold"]:
            speed = -x * s["x_scale"]
            self.angular = math.copysign(max(s["min_angular_speed"], min(s["max_angular_speed"], abs(speed))), speed)
        else:
            self.angular *= s["slow_down_factor"]
        return self.linear, self.angular
