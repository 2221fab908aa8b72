"""The action "run this instruction", and the messages that ROS 2 derives for an action.

``RunInstruction.action``::

    string instruction
    float64 timeout_s
    ---
    bool success
    string message
    ---
    string status
    float64 elapsed_s
"""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import Message, boolean, float64, int8, string
from vlatool.messages.unique_identifier_msgs import UUID

ACTION = "vlatool_msgs/action/RunInstruction"


@dataclass(frozen=True, eq=False)
class RunInstructionGoal(Message, name=f"{ACTION}_Goal"):
    """What the policy should do, and how many seconds it may take."""

    instruction: string = ""
    timeout_s: float64 = 0.0


@dataclass(frozen=True, eq=False)
class RunInstructionResult(Message, name=f"{ACTION}_Result"):
    """Whether it was done, and in words how it ended."""

    success: boolean = False
    message: string = ""


@dataclass(frozen=True, eq=False)
class RunInstructionFeedback(Message, name=f"{ACTION}_Feedback"):
    """What the controller does, and for how many seconds it has run."""

    status: string = ""
    elapsed_s: float64 = 0.0


@dataclass(frozen=True, eq=False)
class RunInstructionSendGoalRequest(Message, name=f"{ACTION}_SendGoal_Request"):
    """A goal, with the identifier that the client chose."""

    goal_id: UUID = UUID()
    goal: RunInstructionGoal = RunInstructionGoal()


@dataclass(frozen=True, eq=False)
class RunInstructionSendGoalResponse(Message, name=f"{ACTION}_SendGoal_Response"):
    """Whether the goal was accepted, and when."""

    accepted: boolean = False
    stamp: Time = Time()


@dataclass(frozen=True, eq=False)
class RunInstructionGetResultRequest(Message, name=f"{ACTION}_GetResult_Request"):
    """Asks for the result of a goal; it is answered when the goal ends."""

    goal_id: UUID = UUID()


@dataclass(frozen=True, eq=False)
class RunInstructionGetResultResponse(Message, name=f"{ACTION}_GetResult_Response"):
    """How a goal ended, as a status of ``action_msgs/msg/GoalStatus``, and its result."""

    status: int8 = 0
    result: RunInstructionResult = RunInstructionResult()


@dataclass(frozen=True, eq=False)
class RunInstructionFeedbackMessage(Message, name=f"{ACTION}_FeedbackMessage"):
    """The feedback of a goal; the topic is ``ACTION/_action/feedback``."""

    goal_id: UUID = UUID()
    feedback: RunInstructionFeedback = RunInstructionFeedback()
