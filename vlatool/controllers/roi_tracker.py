"""Turn towards a region of interest: the object tracker of the tutorials "ROS by Example"."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import copysign

from vlatool.controllers._base_driver import BaseDriver
from vlatool.controllers._geometry import twist
from vlatool.controllers._interface import Command, Input, Snapshot
from vlatool.controllers._settings import check_finite, check_rate, check_speeds
from vlatool.controllers._target import Target, find_target, read_roi, target_inputs
from vlatool.messages.sensor_msgs import CameraInfo, RegionOfInterest


def offset_of(roi: RegionOfInterest, image_width: int) -> float:
    """Return how far the centre of a region is from that of the image, as a share of half of the image's width.

    Halves of pixels are cut off, as in the tutorial. Positive to the right.
    """
    half = image_width / 2.0
    return (roi.x_offset + roi.width // 2 - image_width // 2) / half


@dataclass(frozen=True)
class RoiTracker(BaseDriver):
    """Turns towards a region of interest, in proportion to its distance from the centre of the image.

    The law is that of ``object_tracker.py`` of Goebel, "ROS by Example": where the centre of the region is more than
    ``x_threshold`` of half of the image's width away from its centre, the robot turns towards it at ``gain`` times
    that share, at least ``min_rotation_speed`` and at most ``max_rotation_speed``; otherwise, and at each step since
    the last of which no region came, it stands.

    Args:
        rate: Steps in a second.
        gain: Rotation speed for a region at the edge of the image, in rad/s.
        x_threshold: Share of half of the image's width within which the robot does not turn.
        min_rotation_speed: In rad/s.
        max_rotation_speed: In rad/s.
        roi: First region as ``X,Y,WIDTH,HEIGHT`` in pixels, which a correlation filter follows in the images; the
            topic ``/roi`` gives it when empty.
        track: Whether a region of the topic is the first one for the correlation filter, too; each newer one begins
            it again.

    Raises:
        UsageError: for a setting out of its range.
    """

    rate: float = 10.0
    gain: float = 2.0
    x_threshold: float = 0.1
    min_rotation_speed: float = 0.5
    max_rotation_speed: float = 2.0
    roi: str = ""
    track: bool = False
    _first: RegionOfInterest | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_finite(self)
        check_rate(self.rate)
        check_speeds("rotation_speed", self.min_rotation_speed, self.max_rotation_speed)
        object.__setattr__(self, "_first", read_roi(self.roi))

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Size of the image; the region, the image or both."""
        return target_inputs(self.roi, self.track)

    def start(self) -> Target:
        """Return the state of a target that was not seen yet."""
        return Target()

    def step(self, snapshot: Snapshot, state: Target) -> tuple[Command, Target]:
        """Return the velocity at this step; zero without a region since the last."""
        region, state, problem = find_target(snapshot, self._first, self.track, state)
        camera = snapshot.message("camera_info", CameraInfo)
        if region is None or camera is None:
            return Command({"cmd_vel": (twist(),)}, status=f"standing: {problem}"), state
        offset = offset_of(region, camera.width)
        command = twist(angular=self.rotation(offset))
        return Command({"cmd_vel": (command,)}, status="tracking", notes={"offset": offset}), state

    def rotation(self, offset: float) -> float:
        """Return the rotation speed in rad/s, to the left, for a region at an offset; see ``offset_of``."""
        if not abs(offset) > self.x_threshold:
            return 0.0
        speed = max(self.min_rotation_speed, min(self.max_rotation_speed, abs(self.gain * offset)))
        return -copysign(speed, offset)
