"""Actions of ROS 2: three services and two topics below the name of the action, which any bus with services can carry.

``send_goal``, ``cancel_goal`` and ``get_result`` are served; ``feedback`` and ``status`` are published.
"""

from __future__ import annotations

import dataclasses
import functools
import threading
import uuid
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from vlatool.buses._goals import Goals
from vlatool.buses._interface import (
    GOAL_ABORTED,
    GOAL_CANCELED,
    GOAL_SUCCEEDED,
    ActionType,
    Bus,
    Goal,
    Outcome,
    QoS,
    Reception,
)
from vlatool.errors import BusError, UsageError
from vlatool.messages import Message, find_type
from vlatool.messages.action_msgs import CancelGoalRequest, CancelGoalResponse, GoalInfo, GoalStatus, GoalStatusArray
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import boolean, define, int8
from vlatool.messages.unique_identifier_msgs import UUID

ANSWER_S = 5.0
"""How long a client waits for a server to take its goal, in seconds."""
GOALS = 100
"""How many goals that have ended a server remembers."""
RELIABLE = QoS(reliable=True, depth=10)
STATUSES = {
    GOAL_SUCCEEDED: GoalStatus.STATUS_SUCCEEDED,
    GOAL_CANCELED: GoalStatus.STATUS_CANCELED,
    GOAL_ABORTED: GoalStatus.STATUS_ABORTED,
}
"""How a goal ended -> its last status."""


class _Types(NamedTuple):
    """Classes of the messages around a goal, its feedback and its result."""

    send_request: Any
    send_response: Any
    result_request: Any
    result_response: Any
    feedback: Any


def types_of(kind: ActionType) -> _Types:
    """Return the classes that ROS 2 derives for an action, such as ``RunInstruction_SendGoal_Request``."""
    return _types(kind.name, *(cast(Any, each) for each in kind[1:]))  # for mypy, no message class is hashable


@functools.cache
def _types(name: str, goal: Any, feedback: Any, result: Any) -> _Types:
    return _Types(
        _class(f"{name}_SendGoal_Request", goal_id=UUID, goal=goal),
        _class(f"{name}_SendGoal_Response", accepted=boolean, stamp=Time),
        _class(f"{name}_GetResult_Request", goal_id=UUID),
        _class(f"{name}_GetResult_Response", status=int8, result=result),
        _class(f"{name}_FeedbackMessage", goal_id=UUID, feedback=feedback),
    )


def _class(name: str, **fields: Any) -> Any:
    """Return the class of a type, with these fields when it is not defined yet."""
    try:
        return find_type(name)
    except UsageError:
        return define(name, fields)


@dataclasses.dataclass
class _Known:
    """A goal that a server knows."""

    info: GoalInfo
    status: int = GoalStatus.STATUS_ACCEPTED
    result: Message | None = None
    ended: threading.Event = dataclasses.field(default_factory=threading.Event)


class ServiceActionServer:
    """Serves an action on a bus.

    Args:
        bus: The bus.
        action: Name of the action.
        kind: Its type.
        handler: Runs a goal.
    """

    def __init__(self, bus: Bus, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        self._bus, self._kind, self._types = bus, kind, types_of(kind)
        self._lock, self._known = threading.Lock(), dict[str, _Known]()
        self._goals = Goals(f"action {action}", kind.result, handler)
        latched = dataclasses.replace(RELIABLE, latched=True)
        top, every = f"{action}/_action", self._types
        self._status = bus.publisher(f"{top}/status", GoalStatusArray, latched)
        self._feedback = bus.publisher(f"{top}/feedback", every.feedback, RELIABLE)
        bus.serve(f"{top}/cancel_goal", CancelGoalRequest, CancelGoalResponse, self._cancel)
        bus.serve(f"{top}/get_result", every.result_request, every.result_response, self._wait_for_result)
        bus.serve(f"{top}/send_goal", every.send_request, every.send_response, self._take)

    def close(self) -> None:
        """Cancel every goal; who waits for a result gets it."""
        self._goals.close()
        with self._lock:
            for known in self._known.values():
                known.ended.set()

    def _take(self, request: Any) -> Any:
        identifier, stamp = _name(request.goal_id), self._bus.stamp()
        with self._lock:
            if identifier in self._known:
                return self._types.send_response(False, stamp)
            self._known[identifier] = _Known(GoalInfo(request.goal_id, stamp))
        self._goals.add(
            identifier, request.goal, lambda message: self._feedback(self._types.feedback(request.goal_id, message)),
            functools.partial(self._finish, identifier),
            functools.partial(self._change, identifier, GoalStatus.STATUS_EXECUTING),
        )  # fmt: skip
        self._tell()
        return self._types.send_response(True, stamp)

    def _cancel(self, request: Any) -> CancelGoalResponse:
        """Cancel as ROS 2 does: the goal of an identifier, those up to a stamp, or all where neither is given."""
        wanted, before = _name(request.goal_info.goal_id), _nanoseconds(request.goal_info.stamp)
        one, every = int(wanted, 16) != 0, not before and int(wanted, 16) == 0
        with self._lock:
            if one and wanted not in self._known:
                return CancelGoalResponse(CancelGoalResponse.ERROR_UNKNOWN_GOAL_ID)
            if one and self._known[wanted].ended.is_set():
                return CancelGoalResponse(CancelGoalResponse.ERROR_GOAL_TERMINATED)
            chosen = {
                name: known.info
                for name, known in self._known.items()
                if not known.ended.is_set()
                and (every or name == wanted or (before and _nanoseconds(known.info.stamp) <= before))
            }
        for name in chosen:
            self._change(name, GoalStatus.STATUS_CANCELING)
            self._goals.cancel(name)
        return CancelGoalResponse(CancelGoalResponse.ERROR_NONE, tuple(chosen.values()))

    def _wait_for_result(self, request: Any) -> Any:
        with self._lock:
            known = self._known.get(_name(request.goal_id))
        if known is None:
            return self._types.result_response(GoalStatus.STATUS_UNKNOWN, self._kind.result())
        known.ended.wait()
        return self._types.result_response(known.status, known.result or self._kind.result())

    def _finish(self, identifier: str, outcome: Outcome) -> None:
        with self._lock:
            known = self._known[identifier]
            # ROS 2 has no canceled goal without a client that asked for it: one that a newer goal replaced is aborted
            asked = known.status == GoalStatus.STATUS_CANCELING
            status = GOAL_ABORTED if outcome.status == GOAL_CANCELED and not asked else outcome.status
            known.status, known.result = STATUSES[status], outcome.result
            known.ended.set()
            ended = [name for name, each in self._known.items() if each.ended.is_set()]
            for name in ended[:-GOALS]:
                del self._known[name]
        self._tell()

    def _change(self, identifier: str, status: int) -> None:
        with self._lock:
            known = self._known[identifier]
            known.status = known.status if known.ended.is_set() else status
        self._tell()

    def _tell(self) -> None:
        with self._lock:
            listing = tuple(GoalStatus(known.info, known.status) for known in self._known.values())
        self._status(GoalStatusArray(listing))


class ServiceActionClient:
    """Sends goals of one action on a bus.

    Args:
        bus: The bus.
        action: Name of the action.
        kind: Its type.
    """

    def __init__(self, bus: Bus, action: str, kind: ActionType) -> None:
        self._bus, self._action, self._types = bus, action, types_of(kind)
        self._hearers: dict[str, Callable[[Message], None]] = {}
        bus.subscribe(f"{action}/_action/feedback", self._types.feedback, self._hear, RELIABLE)

    def send(self, goal: Message, feedback: Callable[[Message], None] | None) -> ServiceGoal:
        """Send a goal; raises BusError when nobody serves the action, or its server refuses the goal."""
        goal_id = UUID(np.frombuffer(uuid.uuid4().bytes, np.uint8))
        if feedback is not None:
            self._hearers[_name(goal_id)] = feedback
        try:
            answer = self.ask("send_goal", self._types.send_request(goal_id, goal), self._types.send_response, ANSWER_S)
        except BusError as error:
            problem = f"Nobody serves the action {self._action}: {error.message}"
            raise BusError(problem, "start the node that serves it") from error
        if not answer.accepted:
            raise BusError(f"The server of {self._action} refused the goal.", "see the node that serves it")
        return ServiceGoal(self, self._action, goal_id, self._types)

    def ask(self, part: str, request: Message, response: Any, timeout_s: float) -> Any:
        """Call one of the action's services."""
        return self._bus.call(f"{self._action}/_action/{part}", request, response, timeout_s)

    def _hear(self, reception: Reception) -> None:
        got: Any = reception.message
        hearer = self._hearers.get(_name(got.goal_id))
        if hearer is not None:
            hearer(got.feedback)


class ServiceGoal:
    """A goal that was sent; see ``ClientGoal``."""

    def __init__(self, client: ServiceActionClient, action: str, goal_id: UUID, known: _Types) -> None:
        self._client, self._action, self._goal_id, self._types = client, action, goal_id, known

    def result(self, timeout_s: float) -> Outcome:
        """See ``ClientGoal.result``."""
        request = self._types.result_request(self._goal_id)
        try:
            answer = self._client.ask("get_result", request, self._types.result_response, timeout_s)
        except BusError as error:
            problem = f"The action {self._action} gave no result within {timeout_s:g} s."
            raise BusError(problem, "wait longer, or cancel it") from error
        ends = {status: end for end, status in STATUSES.items()}
        return Outcome(ends.get(answer.status, GOAL_ABORTED), answer.result)

    def cancel(self) -> None:
        """See ``ClientGoal.cancel``."""
        self._client.ask("cancel_goal", CancelGoalRequest(GoalInfo(self._goal_id)), CancelGoalResponse, ANSWER_S)


def _name(goal_id: UUID) -> str:
    return goal_id.uuid.tobytes().hex()


def _nanoseconds(stamp: Time) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec
