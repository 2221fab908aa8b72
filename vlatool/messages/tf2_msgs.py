"""Types of the ROS package ``tf2_msgs``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.geometry_msgs import TransformStamped
from vlatool.messages.schema import Message


@dataclass(frozen=True, eq=False)
class TFMessage(Message, name="tf2_msgs/msg/TFMessage"):
    """Transforms, as ``/tf`` and ``/tf_static`` carry them."""

    transforms: tuple[TransformStamped, ...] = ()
