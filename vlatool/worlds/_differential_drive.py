"""A differential drive with limits of acceleration that stops when its command is silent, and its wheel odometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass
class DifferentialDrive:
    """Speeds of a base, and where its wheels say that it is.

    Args:
        max_linear, max_angular: Largest speeds, in m/s and rad/s.
        linear_rate, angular_rate: Largest accelerations, in m/s^2 and rad/s^2.
        silence_s: Time after the last command at which it stops by itself.
        slip: Standard deviation of the share by which wheels overrate or underrate a way, of the whole run and of each
            step.
        random: Source of chance.
    """

    max_linear: float
    max_angular: float
    linear_rate: float
    angular_rate: float
    silence_s: float
    slip: float
    random: np.random.Generator
    linear: float = 0.0
    angular: float = 0.0
    odometry: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _target: tuple[float, float] = (0.0, 0.0)
    _commanded_s: float = -math.inf
    _bias: tuple[float, float] = field(default=(0.0, 0.0), init=False)

    def __post_init__(self) -> None:
        self._bias = (float(self.random.normal(0.0, self.slip)), float(self.random.normal(0.0, self.slip)))

    def obey(self, linear: float, angular: float, now_s: float) -> None:
        """Take a command in m/s and rad/s; one that is not finite is none."""
        if math.isfinite(linear) and math.isfinite(angular):
            self._target = (_cut(linear, self.max_linear), _cut(angular, self.max_angular))
            self._commanded_s = now_s

    def advance(self, seconds: float, now_s: float) -> None:
        """Change the speeds, and count the way of the wheels."""
        linear, angular = (0.0, 0.0) if now_s - self._commanded_s >= self.silence_s else self._target
        self.linear += _cut(linear - self.linear, self.linear_rate * seconds)
        self.angular += _cut(angular - self.angular, self.angular_rate * seconds)
        noise = [float(value) for value in self.random.normal(0.0, self.slip, 2)]
        x, y, yaw = self.odometry
        way = self.linear * seconds * (1.0 + self._bias[0] + noise[0])
        turn = self.angular * seconds * (1.0 + self._bias[1] + noise[1])
        middle = yaw + turn / 2.0
        self.odometry = (
            x + way * math.cos(middle),
            y + way * math.sin(middle),
            math.remainder(yaw + turn, 2 * math.pi),
        )


def _cut(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
