"""Types of the ROS package ``diagnostic_msgs``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.messages.schema import Message, byte, string
from vlatool.messages.std_msgs import Header


@dataclass(frozen=True, eq=False)
class KeyValue(Message, name="diagnostic_msgs/msg/KeyValue"):
    """What a value is called, and the value as text."""

    key: string = ""
    value: string = ""


@dataclass(frozen=True, eq=False)
class DiagnosticStatus(Message, name="diagnostic_msgs/msg/DiagnosticStatus"):
    """The state of one component of a robot, at a ``level`` below."""

    OK: ClassVar[byte] = 0
    WARN: ClassVar[byte] = 1
    ERROR: ClassVar[byte] = 2
    STALE: ClassVar[byte] = 3

    level: byte = 0
    name: string = ""
    message: string = ""
    hardware_id: string = ""
    values: tuple[KeyValue, ...] = ()


@dataclass(frozen=True, eq=False)
class DiagnosticArray(Message, name="diagnostic_msgs/msg/DiagnosticArray"):
    """The state of several components at a moment."""

    header: Header = Header()
    status: tuple[DiagnosticStatus, ...] = ()
