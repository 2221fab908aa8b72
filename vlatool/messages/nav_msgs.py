"""Types of the ROS package ``nav_msgs``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.geometry_msgs import PoseWithCovariance, TwistWithCovariance
from vlatool.messages.schema import Message, string
from vlatool.messages.std_msgs import Header


@dataclass(frozen=True, eq=False)
class Odometry(Message, name="nav_msgs/msg/Odometry"):
    """Estimated pose of ``child_frame_id`` in the frame of the header, and its velocity in ``child_frame_id``."""

    header: Header = Header()
    child_frame_id: string = ""
    pose: PoseWithCovariance = PoseWithCovariance()
    twist: TwistWithCovariance = TwistWithCovariance()
