"""Types of the ROS 1 package ``actionlib_msgs``, of which actions are built there; ROS 2 has ``action_msgs``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import Message, string, uint8
from vlatool.messages.std_msgs import Header


@dataclass(frozen=True, eq=False)
class GoalID(Message, name="actionlib_msgs/msg/GoalID"):
    """A goal: when it was sent, and a name that no other one has."""

    stamp: Time = Time()
    id: string = ""


@dataclass(frozen=True, eq=False)
class GoalStatus(Message, name="actionlib_msgs/msg/GoalStatus"):
    """Where a goal stands, as one of the values below, and in words."""

    PENDING: ClassVar[uint8] = 0
    ACTIVE: ClassVar[uint8] = 1
    PREEMPTED: ClassVar[uint8] = 2
    SUCCEEDED: ClassVar[uint8] = 3
    ABORTED: ClassVar[uint8] = 4
    REJECTED: ClassVar[uint8] = 5
    PREEMPTING: ClassVar[uint8] = 6
    RECALLING: ClassVar[uint8] = 7
    RECALLED: ClassVar[uint8] = 8
    LOST: ClassVar[uint8] = 9

    goal_id: GoalID = GoalID()
    status: uint8 = 0
    text: string = ""


@dataclass(frozen=True, eq=False)
class GoalStatusArray(Message, name="actionlib_msgs/msg/GoalStatusArray"):
    """Where the goals of an action stand; the topic is ``ACTION/status``."""

    header: Header = Header()
    status_list: tuple[GoalStatus, ...] = ()
