"""Actions of ROS 1's ``actionlib``: five topics below the name of the action, which any bus with topics can carry.

``goal`` and ``cancel`` go to the server; ``status``, ``feedback`` and ``result`` come from it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, cast

from vlatool.buses._goals import AwaitedGoal, Goals
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
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.actionlib_msgs import GoalID, GoalStatus, GoalStatusArray
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import define
from vlatool.messages.std_msgs import Header

STATUS_S = 0.2
"""How often a server tells where its goals stand, in seconds: actionlib's default."""
KEPT_S = 5.0
"""How long it tells so of a goal that has ended, in seconds: actionlib's default."""
ANSWER_S = 5.0
"""How long a client waits for a server, in seconds."""
RELIABLE = QoS(reliable=True, depth=10)
OUTCOMES = {
    GoalStatus.SUCCEEDED: GOAL_SUCCEEDED,
    GoalStatus.PREEMPTED: GOAL_CANCELED,
    GoalStatus.RECALLED: GOAL_CANCELED,
}
"""Last status of a goal -> how it ended; aborted by any other one."""


class _Types(NamedTuple):
    """Classes of the messages around a goal, its feedback and its result."""

    goal: Any
    feedback: Any
    result: Any


@functools.cache
def _types(name: str, goal: Any, feedback: Any, result: Any) -> _Types:
    package, _, short = name.partition("/action/")
    top, reported = f"{package}/msg/{short}", {"header": Header, "status": GoalStatus}
    return _Types(
        define(f"{top}ActionGoal", {"header": Header, "goal_id": GoalID, "goal": goal}),
        define(f"{top}ActionFeedback", {**reported, "feedback": feedback}),
        define(f"{top}ActionResult", {**reported, "result": result}),
    )


def types_of(kind: ActionType) -> _Types:
    """Return the classes that actionlib derives for an action, such as ``RunInstructionActionGoal``."""
    return _types(kind.name, *(cast(Any, each) for each in kind[1:]))  # for mypy, no message class is hashable


@dataclasses.dataclass
class _Known:
    """A goal that a server knows, and when it ended by ``time.monotonic``."""

    goal_id: GoalID
    status: int = GoalStatus.PENDING
    ended_s: float | None = None


class TopicActionServer:
    """Serves an action on a bus.

    Args:
        bus: The bus.
        action: Name of the action.
        kind: Its type.
        handler: Runs a goal.
    """

    def __init__(self, bus: Bus, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        self._bus, self._types = bus, types_of(kind)
        self._known: dict[str, _Known] = {}
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._numbers = itertools.count()
        self._goals = Goals(f"action {action}", kind.result, handler)
        self._status = bus.publisher(f"{action}/status", GoalStatusArray, dataclasses.replace(RELIABLE, latched=True))
        self._feedback = bus.publisher(f"{action}/feedback", self._types.feedback, RELIABLE)
        self._result = bus.publisher(f"{action}/result", self._types.result, RELIABLE)
        bus.subscribe(f"{action}/cancel", GoalID, self._take_cancel, RELIABLE)
        bus.subscribe(f"{action}/goal", self._types.goal, self._take_goal, RELIABLE)
        self._thread = threading.Thread(target=self._tell_regularly, name=f"status {action}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Cancel every goal and tell so."""
        if not self._closed.is_set():
            self._closed.set()
            self._goals.close()
            self._thread.join(1.0)

    def _take_goal(self, reception: Reception) -> None:
        got: Any = reception.message
        identifier = got.goal_id.id or f"unnamed_{next(self._numbers)}"
        with self._lock:
            if identifier in self._known:
                return
            self._known[identifier] = _Known(GoalID(got.goal_id.stamp, identifier))
        self._goals.add(
            identifier, got.goal, functools.partial(self._report, identifier),
            functools.partial(self._finish, identifier),
            functools.partial(self._change, identifier, GoalStatus.ACTIVE),
        )  # fmt: skip
        self._tell()

    def _take_cancel(self, reception: Reception) -> None:
        """Cancel as actionlib does: the goal of a name, those up to a stamp, or all where neither is given."""
        wanted: Any = reception.message
        before = _nanoseconds(wanted.stamp)
        with self._lock:
            chosen = [
                name
                for name, known in self._known.items()
                if known.ended_s is None
                and (name == wanted.id or (before and _nanoseconds(known.goal_id.stamp) <= before)
                     or not (wanted.id or before))
            ]  # fmt: skip
        for name in chosen:
            active = self._known[name].status == GoalStatus.ACTIVE
            self._change(name, GoalStatus.PREEMPTING if active else GoalStatus.RECALLING)
            self._goals.cancel(name)

    def _report(self, identifier: str, message: Message) -> None:
        self._feedback(self._types.feedback(Header(self._bus.stamp()), self._now(identifier), message))

    def _finish(self, identifier: str, outcome: Outcome) -> None:
        with self._lock:
            known = self._known[identifier]
            ran = known.status in (GoalStatus.ACTIVE, GoalStatus.PREEMPTING)
            canceled = GoalStatus.PREEMPTED if ran else GoalStatus.RECALLED
            known.status = {GOAL_SUCCEEDED: GoalStatus.SUCCEEDED, GOAL_CANCELED: canceled}.get(
                outcome.status, GoalStatus.ABORTED
            )
            known.ended_s = time.monotonic()
        self._result(self._types.result(Header(self._bus.stamp()), self._now(identifier), outcome.result))
        self._tell()

    def _change(self, identifier: str, status: int) -> None:
        with self._lock:
            known = self._known[identifier]
            known.status = status if known.ended_s is None else known.status
        self._tell()

    def _now(self, identifier: str) -> GoalStatus:
        with self._lock:
            known = self._known[identifier]
            return GoalStatus(known.goal_id, known.status)

    def _tell(self) -> None:
        with self._lock:
            listing = tuple(GoalStatus(known.goal_id, known.status) for known in self._known.values())
        self._status(GoalStatusArray(Header(self._bus.stamp()), listing))

    def _tell_regularly(self) -> None:
        while not self._closed.wait(STATUS_S):
            now = time.monotonic()
            with self._lock:
                self._known = {
                    name: known
                    for name, known in self._known.items()
                    if known.ended_s is None or now - known.ended_s < KEPT_S
                }
            try:
                self._tell()
            except BusError:
                return  # the bus is closed


class TopicActionClient:
    """Sends goals of one action on a bus.

    Args:
        bus: The bus.
        node: Name of this node, for names of goals.
        action: Name of the action.
        kind: Its type.
    """

    def __init__(self, bus: Bus, node: str, action: str, kind: ActionType) -> None:
        self._bus, self._node, self._action, self._types = bus, node, action, types_of(kind)
        self._numbers = itertools.count()
        self._sent: dict[str, TopicGoal] = {}
        self._send = bus.publisher(f"{action}/goal", self._types.goal, RELIABLE)
        self.cancel: Callable[[GoalID], None] = bus.publisher(f"{action}/cancel", GoalID, RELIABLE)
        bus.subscribe(f"{action}/feedback", self._types.feedback, self._take_feedback, RELIABLE)
        bus.subscribe(f"{action}/result", self._types.result, self._take_result, RELIABLE)

    def send(self, goal: Message, feedback: Callable[[Message], None] | None) -> TopicGoal:
        """Send a goal; raises BusError when nobody serves the action."""
        topics = tuple(f"{self._action}/{part}" for part in ("goal", "cancel", "feedback", "result"))
        if self._bus.wait_for_peers(topics, ANSWER_S):
            raise BusError(f"Nobody serves the action {self._action}.", "start the node that serves it")
        stamp = self._bus.stamp()
        goal_id = GoalID(stamp, f"/{self._node}-{next(self._numbers)}-{stamp.sec}.{stamp.nanosec}")
        sent = self._sent[goal_id.id] = TopicGoal(self, self._action, goal_id, feedback)
        self._send(self._types.goal(Header(stamp), goal_id, goal))
        return sent

    def _take_feedback(self, reception: Reception) -> None:
        got: Any = reception.message
        sent = self._sent.get(got.status.goal_id.id)
        if sent is not None and sent.feedback is not None:
            sent.feedback(got.feedback)

    def _take_result(self, reception: Reception) -> None:
        got: Any = reception.message
        sent = self._sent.pop(got.status.goal_id.id, None)
        if sent is not None:
            sent.finish(Outcome(OUTCOMES.get(got.status.status, GOAL_ABORTED), got.result))


class TopicGoal(AwaitedGoal):
    """A goal that was sent; see ``ClientGoal``."""

    def __init__(
        self, client: TopicActionClient, action: str, goal_id: GoalID, feedback: Callable[[Message], None] | None
    ) -> None:
        super().__init__(action)
        self.feedback = feedback
        self._client, self._goal_id = client, goal_id

    def cancel(self) -> None:
        """See ``ClientGoal.cancel``."""
        self._client.cancel(GoalID(id=self._goal_id.id))


def _nanoseconds(stamp: Time) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec
