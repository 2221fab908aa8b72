"""Actions of rclpy: its server runs our goals, its client sends them."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable
from typing import Any

from vlatool.buses._goals import Goals
from vlatool.buses._interface import GOAL_ABORTED, GOAL_CANCELED, GOAL_SUCCEEDED, ActionType, Goal, Outcome
from vlatool.buses._rclpy_messages import from_ros, generated_class, to_ros
from vlatool.errors import BusError
from vlatool.messages import Message

STATUSES = {4: GOAL_SUCCEEDED, 5: GOAL_CANCELED, 6: GOAL_ABORTED}
"""Status of ``action_msgs/msg/GoalStatus`` -> how a goal ended."""
ANSWER_S = 5.0
"""How long a client waits for a server to accept its goal, in seconds."""


def serve_action(
    node: Any, name: str, kind: ActionType, handler: Callable[[Goal], Outcome], make_future: Callable[[], Any]
) -> Callable[[], None]:
    """Serve an action; return what ends that.

    Args:
        node: Node of rclpy.
        name: Full name of the action.
        kind: Its type.
        handler: Runs a goal.
        make_future: Returns a future of rclpy that wakes its executor.
    """
    actions = importlib.import_module("rclpy.action")
    goals = Goals(f"ros2 {name}", kind.result, handler)

    async def execute(handle: Any) -> Any:
        future = make_future()
        identifier = bytes(handle.goal_id.uuid).hex()
        goals.add(
            identifier,
            from_ros(kind.goal, handle.request),
            lambda message: handle.publish_feedback(to_ros(message)),
            future.set_result,
        )
        outcome = await future
        ends = {GOAL_SUCCEEDED: handle.succeed, GOAL_CANCELED: handle.canceled, GOAL_ABORTED: handle.abort}
        # ROS 2 has no canceled goal without a client that asked for it: one that a newer goal replaced is aborted
        status = GOAL_ABORTED if outcome.status == GOAL_CANCELED and not handle.is_cancel_requested else outcome.status
        ends[status]()
        return to_ros(outcome.result)

    def cancel(handle: Any) -> Any:
        goals.cancel(bytes(handle.goal_id.uuid).hex())
        return actions.CancelResponse.ACCEPT

    server = actions.ActionServer(node, generated_class(kind.name), name, execute, cancel_callback=cancel)

    def end() -> None:
        goals.close()
        server.destroy()

    return end


class ClientGoal:
    """A goal that rclpy's client sent; see ``ClientGoal`` of the interface."""

    def __init__(self, node: Any, name: str, kind: ActionType) -> None:
        self._name, self._kind = name, kind
        self._client = importlib.import_module("rclpy.action").ActionClient(node, generated_class(kind.name), name)
        self._ended = threading.Event()
        self._handle: Any = None
        self._result: Any = None

    def send(self, goal: Message, feedback: Callable[[Message], None] | None) -> None:
        """Send the goal; raises BusError when nobody serves the action, or the goal is refused."""
        if not self._client.wait_for_server(timeout_sec=ANSWER_S):
            raise BusError(f"Nobody serves the action {self._name}.", "start the node that serves it; ros2 action list")

        def report(theirs: Any) -> None:
            if feedback is not None:
                feedback(from_ros(self._kind.feedback, theirs.feedback))

        answered = threading.Event()
        future = self._client.send_goal_async(to_ros(goal), feedback_callback=report)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(ANSWER_S):
            raise BusError(f"The action {self._name} did not answer within {ANSWER_S:g} s.", "see what its node prints")
        self._handle = future.result()
        if not self._handle.accepted:
            raise BusError(f"The action {self._name} refused the goal.", "see what its node prints")
        self._result = self._handle.get_result_async()
        self._result.add_done_callback(lambda _: self._ended.set())

    def result(self, timeout_s: float) -> Outcome:
        """See ``ClientGoal.result``."""
        if not self._ended.wait(timeout_s):
            raise BusError(
                f"The action {self._name} gave no result within {timeout_s:g} s.", "wait longer, or cancel it"
            )
        found = self._result.result()
        return Outcome(STATUSES.get(found.status, GOAL_ABORTED), from_ros(self._kind.result, found.result))

    def cancel(self) -> None:
        """See ``ClientGoal.cancel``."""
        self._handle.cancel_goal_async()
