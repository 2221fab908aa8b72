"""Types of the ROS package ``std_msgs``."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import Message, Ros1Form, boolean, float32, string


@dataclass(frozen=True, eq=False)
class Header(Message, name="std_msgs/msg/Header", ros1=Ros1Form(sequence=True)):
    """When and in which frame the data of a message were taken."""

    stamp: Time = Time()
    frame_id: string = ""


@dataclass(frozen=True, eq=False)
class String(Message, name="std_msgs/msg/String"):
    """A text."""

    data: string = ""


@dataclass(frozen=True, eq=False)
class Bool(Message, name="std_msgs/msg/Bool"):
    """A truth value."""

    data: boolean = False


@dataclass(frozen=True, eq=False)
class ColorRGBA(Message, name="std_msgs/msg/ColorRGBA"):
    """A colour, each part from 0 to 1."""

    r: float32 = 0.0
    g: float32 = 0.0
    b: float32 = 0.0
    a: float32 = 0.0
