"""Follow what stands in a box in front of the camera: the follower of the tutorials "ROS by Example"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from vlatool.controllers._base_driver import BaseDriver
from vlatool.controllers._geometry import twist
from vlatool.controllers._interface import Command, Input, Snapshot
from vlatool.controllers._sensor_arrays import points_of
from vlatool.controllers._settings import check_finite, check_range, check_rate, check_speeds
from vlatool.controllers._smoothing import Motion, within
from vlatool.messages.sensor_msgs import PointCloud2


@dataclass(frozen=True)
class CloudFollower(BaseDriver):
    """Keeps a distance from the mean of the points in a box in front of the camera, and turns towards it.

    The law is that of ``follower.py`` of Goebel, "ROS by Example", which has it from ``turtlebot_follower``, with the
    smoothing of its later version. The box is in the frame of the camera: x to the right, y upwards, z forward. Where
    the mean is more than ``z_threshold`` away from ``goal_z``, the robot drives at ``z_scale`` times the difference;
    where it is more than ``x_threshold`` to one side, it turns at ``x_scale`` times x. Each speed is raised to its
    minimum and cut to its maximum; where it is not asked for, it falls to ``slow_down_factor`` of itself with each
    cloud. ``lost_s`` after the last cloud with points in the box, which the tutorial does not know, the robot stands.

    Args:
        rate: Steps in a second.
        min_x, max_x: Left and right side of the box, in metres.
        min_y, max_y: Lower and upper side, in metres; the tutorial has -0.3, which for a camera 0.244 m above the floor
            has the floor in it.
        max_z: Far side, in metres.
        goal_z: Distance to keep, in metres.
        z_threshold: Difference of the distance below which the robot does not drive, in metres.
        x_threshold: Distance to the side below which it does not turn, in metres.
        z_scale: Speed for a difference, in 1/s.
        x_scale: Rotation speed for a distance to the side, in rad/s for a metre.
        min_linear_speed: In m/s.
        max_linear_speed: In m/s.
        min_angular_speed: In rad/s.
        max_angular_speed: In rad/s.
        slow_down_factor: Share of the speed that is left after a step, from 0 to 1.
        lost_s: Time without points after which the robot stands, in seconds.

    Raises:
        UsageError: for a setting out of its range.
    """

    rate: float = 10.0
    min_x: float = -0.2
    max_x: float = 0.2
    min_y: float = -0.2
    max_y: float = 0.5
    max_z: float = 1.2
    goal_z: float = 0.6
    z_threshold: float = 0.05
    x_threshold: float = 0.05
    z_scale: float = 1.0
    x_scale: float = 2.5
    min_linear_speed: float = 0.1
    max_linear_speed: float = 0.3
    min_angular_speed: float = 0.0
    max_angular_speed: float = 2.0
    slow_down_factor: float = 0.8
    lost_s: float = 0.5

    def __post_init__(self) -> None:
        check_finite(self)
        check_rate(self.rate)
        check_speeds("linear_speed", self.min_linear_speed, self.max_linear_speed)
        check_speeds("angular_speed", self.min_angular_speed, self.max_angular_speed)
        check_range("slow_down_factor", self.slow_down_factor, 0.0, 1.0)
        check_range("lost_s", self.lost_s, 0.0)

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Points in the optical frame of the camera: x to the right, y down, z forward."""
        return (Input("cloud", "/camera/depth/points", PointCloud2),)

    def start(self) -> Motion:
        """Return the state of a robot that stands and has not seen its target."""
        return Motion()

    def step(self, snapshot: Snapshot, state: Motion) -> tuple[Command, Motion]:
        """Return the velocity at this step."""
        points, problem = points_of(snapshot.message("cloud", PointCloud2))
        new = bool(snapshot.readings.get("cloud"))
        mean = self.centroid(points) if points is not None and new else None
        if mean is None:
            problem = "no new cloud" if not new else problem or "nothing in the box"
            state = state.fade(self.slow_down_factor, snapshot.time_s, self.lost_s)
            return self._command(state, f"standing: {problem}", {}), state
        x, z = mean
        state = Motion(self.linear(z, state.linear), self.rotation(x, state.angular), snapshot.time_s)
        return self._command(state, "following", {"side_m": x, "distance_m": z}), state

    def centroid(self, points: NDArray[Any]) -> tuple[float, float] | None:
        """Return the mean (x, z) of the points in the box, in metres; None without one."""
        x, up, z = points[:, 0], -points[:, 1], points[:, 2]
        inside = points[(up > self.min_y) & (up < self.max_y) & (x > self.min_x) & (x < self.max_x) & (z < self.max_z)]
        return (float(inside[:, 0].mean()), float(inside[:, 2].mean())) if len(inside) else None

    def linear(self, z: float, last: float) -> float:
        """Return the speed forward in m/s, for a distance in metres and the last speed."""
        if not abs(z - self.goal_z) > self.z_threshold:
            return last * self.slow_down_factor
        return within((z - self.goal_z) * self.z_scale, self.min_linear_speed, self.max_linear_speed)

    def rotation(self, x: float, last: float) -> float:
        """Return the rotation speed in rad/s, to the left, for a distance to the right in metres and the last speed."""
        if not abs(x) > self.x_threshold:
            return last * self.slow_down_factor
        return within(-x * self.x_scale, self.min_angular_speed, self.max_angular_speed)

    def _command(self, state: Motion, status: str, notes: dict[str, float | str]) -> Command:
        return Command({"cmd_vel": (twist(state.linear, state.angular),)}, status=status, notes=notes)
