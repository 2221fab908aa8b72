"""Types of the ROS package ``action_msgs``: goals of actions, their status, how they are cancelled; ROS 2 alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import Message, int8
from vlatool.messages.unique_identifier_msgs import UUID


@dataclass(frozen=True, eq=False)
class GoalInfo(Message, name="action_msgs/msg/GoalInfo"):
    """A goal, and when it was accepted."""

    goal_id: UUID = UUID()
    stamp: Time = Time()


@dataclass(frozen=True, eq=False)
class GoalStatus(Message, name="action_msgs/msg/GoalStatus"):
    """Where a goal stands, as one of the values below."""

    STATUS_UNKNOWN: ClassVar[int8] = 0
    STATUS_ACCEPTED: ClassVar[int8] = 1
    STATUS_EXECUTING: ClassVar[int8] = 2
    STATUS_CANCELING: ClassVar[int8] = 3
    STATUS_SUCCEEDED: ClassVar[int8] = 4
    STATUS_CANCELED: ClassVar[int8] = 5
    STATUS_ABORTED: ClassVar[int8] = 6

    goal_info: GoalInfo = GoalInfo()
    status: int8 = 0


@dataclass(frozen=True, eq=False)
class GoalStatusArray(Message, name="action_msgs/msg/GoalStatusArray"):
    """Where all goals of an action stand; the topic is ``ACTION/_action/status``."""

    status_list: tuple[GoalStatus, ...] = ()


@dataclass(frozen=True, eq=False)
class CancelGoalRequest(Message, name="action_msgs/srv/CancelGoal_Request"):
    """Goals to cancel: this one; with an identifier of zeros, those accepted up to the stamp; with neither, all."""

    goal_info: GoalInfo = GoalInfo()


@dataclass(frozen=True, eq=False)
class CancelGoalResponse(Message, name="action_msgs/srv/CancelGoal_Response"):
    """Whether goals are being cancelled, as one of the codes below, and which."""

    ERROR_NONE: ClassVar[int8] = 0
    ERROR_REJECTED: ClassVar[int8] = 1
    ERROR_UNKNOWN_GOAL_ID: ClassVar[int8] = 2
    ERROR_GOAL_TERMINATED: ClassVar[int8] = 3

    return_code: int8 = 0
    goals_canceling: tuple[GoalInfo, ...] = ()
