"""Types of the ROS package ``trajectory_msgs``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.builtin_interfaces import Duration
from vlatool.messages.schema import Message, float64_sequence, string_sequence, zeros
from vlatool.messages.std_msgs import Header


@dataclass(frozen=True, eq=False)
class JointTrajectoryPoint(Message, name="trajectory_msgs/msg/JointTrajectoryPoint"):
    """What each joint does at a time after the start; each array is empty or one element for each joint."""

    positions: float64_sequence = zeros("float64")
    velocities: float64_sequence = zeros("float64")
    accelerations: float64_sequence = zeros("float64")
    effort: float64_sequence = zeros("float64")
    time_from_start: Duration = Duration()


@dataclass(frozen=True, eq=False)
class JointTrajectory(Message, name="trajectory_msgs/msg/JointTrajectory"):
    """A trajectory of named joints; a stamp of 0 starts at once."""

    header: Header = Header()
    joint_names: string_sequence = ()
    points: tuple[JointTrajectoryPoint, ...] = ()
