"""Follow a region of interest at a distance: the object follower of the tutorials "ROS by Example"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.controllers._base_driver import BaseDriver
from vlatool.controllers._geometry import twist
from vlatool.controllers._interface import Command, Input, Snapshot
from vlatool.controllers._sensor_arrays import depth_of
from vlatool.controllers._settings import check_finite, check_range, check_rate, check_speeds
from vlatool.controllers._smoothing import Motion, within
from vlatool.controllers._target import find_target, read_roi, target_inputs
from vlatool.controllers.roi_tracker import offset_of
from vlatool.messages.sensor_msgs import CameraInfo, Image, RegionOfInterest


@dataclass(frozen=True)
class RoiFollower(BaseDriver):
    """Turns towards a region of interest and keeps a distance from it.

    The law is that of ``object_follower.py`` of Goebel, "ROS by Example". It turns as ``roi-tracker``, at ``x_scale``.
    The distance is the mean depth of the middle ``scale_roi`` of the region, without what is unknown or beyond
    ``max_z``. Where it is more than ``z_threshold`` away from ``goal_z``, and between ``min_z`` and ``max_z``, the
    robot drives at ``z_scale`` times the difference, at least ``min_linear_speed`` and at most ``max_linear_speed``;
    otherwise its speed falls to ``slow_down_factor`` of itself at each step. Without a new region both speeds fall in
    this way; ``lost_s`` after the last one, which the tutorial does not know, the robot stands. Nor does it drive by
    a depth image that is older than that.

    Args:
        rate: Steps in a second.
        scale_roi: Share of the region's width and height whose depth counts.
        x_threshold: Share of half of the image's width within which the robot does not turn.
        x_scale: Rotation speed for a region at the edge of the image, in rad/s.
        z_threshold: Difference of the distance below which the robot does not drive, in metres.
        z_scale: Speed for a difference, in 1/s.
        goal_z: Distance to keep, in metres.
        min_z: Distance up to which depth is not trusted, in metres.
        max_z: Distance from which depth does not belong to the target, in metres.
        min_linear_speed: In m/s.
        max_linear_speed: In m/s.
        min_rotation_speed: In rad/s.
        max_rotation_speed: In rad/s.
        slow_down_factor: Share of the speed that is left after a step, from 0 to 1.
        lost_s: Time without a target after which the robot stands, in seconds.
        roi: First region as ``X,Y,WIDTH,HEIGHT`` in pixels; see ``roi-tracker``.
        track: Whether a correlation filter follows the region; see ``roi-tracker``.

    Raises:
        UsageError: for a setting out of its range.
    """

    rate: float = 10.0
    scale_roi: float = 0.9
    x_threshold: float = 0.1
    x_scale: float = 2.0
    z_threshold: float = 0.05
    z_scale: float = 0.5
    goal_z: float = 0.75
    min_z: float = 0.5
    max_z: float = 1.6
    min_linear_speed: float = 0.02
    max_linear_speed: float = 0.3
    min_rotation_speed: float = 0.5
    max_rotation_speed: float = 2.0
    slow_down_factor: float = 0.8
    lost_s: float = 0.5
    roi: str = ""
    track: bool = False
    _first: RegionOfInterest | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_finite(self)
        check_rate(self.rate)
        check_speeds("linear_speed", self.min_linear_speed, self.max_linear_speed)
        check_speeds("rotation_speed", self.min_rotation_speed, self.max_rotation_speed)
        check_range("slow_down_factor", self.slow_down_factor, 0.0, 1.0)
        check_range("scale_roi", self.scale_roi, 0.0, 1.0)
        check_range("lost_s", self.lost_s, 0.0)
        object.__setattr__(self, "_first", read_roi(self.roi))

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Size of the image and depth; the region, the image or both."""
        return (*target_inputs(self.roi, self.track), Input("depth", "/camera/depth/image_raw", Image))

    def start(self) -> Motion:
        """Return the state of a robot that stands and has not seen its target."""
        return Motion()

    def step(self, snapshot: Snapshot, state: Motion) -> tuple[Command, Motion]:
        """Return the velocity at this step."""
        region, target, problem = find_target(snapshot, self._first, self.track, state.target)
        state = state._replace(target=target)
        camera = snapshot.message("camera_info", CameraInfo)
        if region is None or camera is None:
            state = state.fade(self.slow_down_factor, snapshot.time_s, self.lost_s)
            return self._command(state, f"standing: {problem}", {}), state
        depth, problem = depth_of(snapshot.message("depth", Image))
        if (age := snapshot.age_s("depth")) > self.lost_s and depth is not None:
            depth, problem = None, f"depth {age:.1f} s old"
        distance = self.distance(depth, region) if depth is not None else None
        offset = offset_of(region, camera.width)
        state = Motion(self.linear(distance, state.linear), self.rotation(offset), snapshot.time_s, target)
        notes: dict[str, float | str] = {"offset": offset}
        if distance is None:
            return self._command(state, f"turning: {problem or 'no depth'}", notes), state
        return self._command(state, "following", {**notes, "distance_m": distance}), state

    def distance(self, depth: NDArray[Any], roi: RegionOfInterest) -> float | None:
        """Return the mean depth of the middle of a region, in metres; None where nothing of it is known."""
        width, height = int(roi.width * self.scale_roi), int(roi.height * self.scale_roi)
        left = int(roi.x_offset + roi.width * (1.0 - self.scale_roi) / 2.0)
        top = int(roi.y_offset + roi.height * (1.0 - self.scale_roi) / 2.0)
        part = depth[top : top + height, left : left + width]
        part = part[part <= self.max_z]
        return float(part.mean(dtype=np.float64)) if part.size else None

    def linear(self, distance: float | None, last: float) -> float:
        """Return the speed forward in m/s, for a distance in metres and the last speed."""
        near = distance is not None and self.min_z < distance < self.max_z
        if distance is None or not near or not abs(distance - self.goal_z) > self.z_threshold:
            return last * self.slow_down_factor
        return within((distance - self.goal_z) * self.z_scale, self.min_linear_speed, self.max_linear_speed)

    def rotation(self, offset: float) -> float:
        """Return the rotation speed in rad/s, to the left, for a region at an offset."""
        if not abs(offset) > self.x_threshold:
            return 0.0
        return -within(self.x_scale * offset, self.min_rotation_speed, self.max_rotation_speed)

    def _command(self, state: Motion, status: str, notes: dict[str, float | str]) -> Command:
        return Command({"cmd_vel": (twist(state.linear, state.angular),)}, status=status, notes=notes)
