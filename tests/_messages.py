"""Random messages of every type, and the same messages as rosbags has them."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from vlatool.messages import Message
from vlatool.messages._members import Member, members

ONE, NAMED, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of fields in rosbags' tables: a primitive, a message, a fixed-size array, a sequence."""
UUID = "unique_identifier_msgs/msg/UUID"
RUN = "vlatool_msgs/action/RunInstruction"
FLOATS = (0.0, -0.0, 1.0, -1.5, float("inf"), float("-inf"), float("nan"), 2.0**-149, 3.0e38)
LETTERS = "aZ_/ 0é机🤖\n\x7f"


def _of(name: str) -> tuple[int, Any]:
    return (NAMED, name) if "/" in name else (ONE, (name, 0))


def _fields(*lines: str) -> list[tuple[str, Any]]:
    """Fields of lines such as ``float64 timeout_s`` and ``action_msgs/msg/GoalInfo[] goals``, as rosbags has them."""
    found: list[tuple[str, Any]] = []
    for line in lines:
        kind, name = line.split()
        if kind.endswith("[<=1]"):
            found.append((name, (SEQUENCE, (_of(kind[:-5]), 1))))
        elif kind.endswith("[]"):
            found.append((name, (SEQUENCE, (_of(kind[:-2]), 0))))
        else:
            found.append((name, _of(kind)))
    return found


EMPTY = _fields("uint8 structure_needs_at_least_one_member")
SERVICES: dict[str, Any] = {
    "std_srvs/srv/SetBool_Request": ([], _fields("bool data")),
    "std_srvs/srv/SetBool_Response": ([], _fields("bool success", "string message")),
    "std_srvs/srv/Trigger_Request": ([], EMPTY),
    "std_srvs/srv/Trigger_Response": ([], _fields("bool success", "string message")),
}
ACTIONS: dict[str, Any] = {
    "action_msgs/srv/CancelGoal_Request": ([], _fields("action_msgs/msg/GoalInfo goal_info")),
    "action_msgs/srv/CancelGoal_Response": (
        [("ERROR_NONE", "int8", 0), ("ERROR_REJECTED", "int8", 1), ("ERROR_UNKNOWN_GOAL_ID", "int8", 2),
         ("ERROR_GOAL_TERMINATED", "int8", 3)],
        _fields("int8 return_code", "action_msgs/msg/GoalInfo[] goals_canceling"),
    ),
    f"{RUN}_Goal": ([], _fields("string instruction", "float64 timeout_s")),
    f"{RUN}_Result": ([], _fields("bool success", "string message")),
    f"{RUN}_Feedback": ([], _fields("string status", "float64 elapsed_s")),
    f"{RUN}_SendGoal_Request": ([], _fields(f"{UUID} goal_id", f"{RUN}_Goal goal")),
    f"{RUN}_SendGoal_Response": ([], _fields("bool accepted", "builtin_interfaces/msg/Time stamp")),
    f"{RUN}_GetResult_Request": ([], _fields(f"{UUID} goal_id")),
    f"{RUN}_GetResult_Response": ([], _fields("int8 status", f"{RUN}_Result result")),
    f"{RUN}_FeedbackMessage": ([], _fields(f"{UUID} goal_id", f"{RUN}_Feedback feedback")),
}  # fmt: skip
"""Types that rosbags lacks, transcribed from the ``.srv`` and ``.action`` files and from ROS 2's design of actions."""
ROS2_ALONE = ("action_msgs/", "unique_identifier_msgs/", "vlatool_msgs/", "visualization_msgs/msg/MeshFile",
              "visualization_msgs/msg/UVCoordinate")  # fmt: skip


def ros2_store() -> Typestore:
    """rosbags' types of Jazzy, with those that it lacks."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register({**SERVICES, **ACTIONS})
    return store


def ros1_store() -> Typestore:
    """rosbags' types of Noetic, with those that it lacks."""
    store = get_typestore(Stores.ROS1_NOETIC)
    transforms = _fields("geometry_msgs/msg/TransformStamped[] transforms")
    store.register({**SERVICES, "tf2_msgs/msg/TFMessage": ([], transforms)})
    return store


def in_ros1(cls: type[Message]) -> bool:
    """Whether Noetic has a type."""
    return not cls.TYPE.startswith(ROS2_ALONE)


def as_rosbags(message: Message, store: Typestore, ros1: bool = False) -> Any:
    """The same message as an instance of rosbags' class; ``seq`` of headers is 0."""
    values = {
        member.name: _as_rosbags(getattr(message, member.attribute), store, ros1) if member.attribute else 0
        for member in members(type(message), ros1)
    }
    return store.types[message.TYPE](**values)


def _as_rosbags(value: Any, store: Typestore, ros1: bool) -> Any:
    if isinstance(value, Message):
        return as_rosbags(value, store, ros1)
    return [_as_rosbags(item, store, ros1) for item in value] if isinstance(value, tuple) else value


class Drawer:
    """Draws messages: limits of integers, infinities, NaN, empty and long sequences, texts in several alphabets."""

    def __init__(self, seed: int) -> None:
        self.draw = random.Random(seed)

    def message(self, cls: type[Message]) -> Message:
        """Return a random message of a type."""
        return cls(**{member.attribute: self._value(member) for member in members(cls)})

    def _value(self, member: Member) -> Any:
        if member.primitive and member.primitive != "string" and (member.sequence or member.length):
            dtype = np.dtype(member.primitive)
            count = member.length or self.draw.choice((0, 0, 1, 2, 3, 5, 8, 31))
            return np.frombuffer(self.draw.randbytes(count * dtype.itemsize), dtype)
        one = (lambda: self.message(member.message)) if member.message else self._scalar(member.primitive)
        return tuple(one() for _ in range(self.draw.choice((0, 1, 2, 5)))) if member.sequence else one()

    def _scalar(self, primitive: str) -> Callable[[], Any]:
        draw = self.draw
        if primitive == "string":
            return lambda: "".join(draw.choices(LETTERS, k=draw.choice((0, 1, 2, 3, 4, 7, 12))))
        if primitive == "bool":
            return lambda: draw.random() < 0.5
        if primitive.startswith("float"):
            single = primitive == "float32"
            return lambda: _rounded(draw.choice((*FLOATS, draw.gauss(0, 1e3), draw.gauss(0, 1))), single)
        if primitive == "byte":  # for rosbags it is signed, as in ROS 1; in ROS 2 it is not
            return lambda: draw.randint(0, 127)
        limits = np.iinfo(primitive)
        return lambda: draw.choice((0, 1, int(limits.min), int(limits.max), draw.randint(limits.min, limits.max)))


def _rounded(value: float, single: bool) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0] if single else value


def without_absent(message: Message) -> Message:
    """The message that is read when this one was sent over ROS 1: fields that it lacks have their defaults."""
    values = {}
    for member in members(type(message), ros1=True):
        if member.attribute:
            value = getattr(message, member.attribute)
            many = isinstance(value, tuple) and member.message is not None
            values[member.attribute] = (
                tuple(map(without_absent, value))
                if many
                else without_absent(value)
                if isinstance(value, Message)
                else value
            )
    return type(message)(**values)
