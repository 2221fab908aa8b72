"""Types of the ROS package ``geometry_msgs``: metres, radians, newtons."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.schema import Message, float64, float64_36, string, zeros
from vlatool.messages.std_msgs import Header


@dataclass(frozen=True, eq=False)
class Vector3(Message, name="geometry_msgs/msg/Vector3"):
    """A free vector."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass(frozen=True, eq=False)
class Point(Message, name="geometry_msgs/msg/Point"):
    """A position, in metres."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass(frozen=True, eq=False)
class Quaternion(Message, name="geometry_msgs/msg/Quaternion"):
    """An orientation; the default is none, as in ROS 2."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass(frozen=True, eq=False)
class Pose(Message, name="geometry_msgs/msg/Pose"):
    """A position and an orientation."""

    position: Point = Point()
    orientation: Quaternion = Quaternion()


@dataclass(frozen=True, eq=False)
class PoseStamped(Message, name="geometry_msgs/msg/PoseStamped"):
    """A pose at a moment, in a frame."""

    header: Header = Header()
    pose: Pose = Pose()


@dataclass(frozen=True, eq=False)
class PoseWithCovariance(Message, name="geometry_msgs/msg/PoseWithCovariance"):
    """A pose and its covariance, (36,), row-major over x, y, z and the rotations about them."""

    pose: Pose = Pose()
    covariance: float64_36 = zeros("float64", 36)


@dataclass(frozen=True, eq=False)
class Twist(Message, name="geometry_msgs/msg/Twist"):
    """A velocity: linear in m/s, angular in rad/s."""

    linear: Vector3 = Vector3()
    angular: Vector3 = Vector3()


@dataclass(frozen=True, eq=False)
class TwistStamped(Message, name="geometry_msgs/msg/TwistStamped"):
    """A velocity at a moment, in a frame."""

    header: Header = Header()
    twist: Twist = Twist()


@dataclass(frozen=True, eq=False)
class TwistWithCovariance(Message, name="geometry_msgs/msg/TwistWithCovariance"):
    """A velocity and its covariance, (36,), row-major."""

    twist: Twist = Twist()
    covariance: float64_36 = zeros("float64", 36)


@dataclass(frozen=True, eq=False)
class Wrench(Message, name="geometry_msgs/msg/Wrench"):
    """A force in newtons and a torque in newton metres."""

    force: Vector3 = Vector3()
    torque: Vector3 = Vector3()


@dataclass(frozen=True, eq=False)
class WrenchStamped(Message, name="geometry_msgs/msg/WrenchStamped"):
    """A wrench at a moment, in a frame."""

    header: Header = Header()
    wrench: Wrench = Wrench()


@dataclass(frozen=True, eq=False)
class Transform(Message, name="geometry_msgs/msg/Transform"):
    """A translation and a rotation."""

    translation: Vector3 = Vector3()
    rotation: Quaternion = Quaternion()


@dataclass(frozen=True, eq=False)
class TransformStamped(Message, name="geometry_msgs/msg/TransformStamped"):
    """A transform from a frame to its child at a moment."""

    header: Header = Header()
    child_frame_id: string = ""
    transform: Transform = Transform()
