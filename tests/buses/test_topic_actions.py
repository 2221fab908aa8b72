from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from vlatool.buses import GOAL_ABORTED, GOAL_CANCELED, GOAL_SUCCEEDED, ActionType, Goal, Outcome, QoS
from vlatool.buses import _topic_actions as topic_actions
from vlatool.buses._topic_actions import TopicActionClient, TopicActionServer, types_of
from vlatool.buses.sim import Sim
from vlatool.errors import BusError
from vlatool.messages import Message, ros1, same
from vlatool.messages.actionlib_msgs import GoalID, GoalStatus, GoalStatusArray
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.schema import int32
from vlatool.messages.std_msgs import Header
from vlatool.messages.vlatool_msgs import (
    ACTION,
    RunInstructionFeedback,
    RunInstructionGoal,
    RunInstructionResult,
)

KIND = ActionType(ACTION, RunInstructionGoal, RunInstructionFeedback, RunInstructionResult)
WAIT_S = 10.0


@dataclass(frozen=True, eq=False)
class Number(Message, name="actionlib/action/Test_Goal"):
    """The goal of actionlib's own tests."""

    goal: int32 = 0


class Nodes:
    """A server and a client on a bus, what the server told, and the goals that it runs."""

    def __init__(self, address: str) -> None:
        self.robot, self.client_node = Sim(address, "robot"), Sim(address, "client")
        self.began = threading.Semaphore(0)
        self.told: list[dict[str, int]] = []
        self.client_node.subscribe("/run/status", GoalStatusArray, self._listen, QoS(depth=100))
        self.server = TopicActionServer(self.robot, "/run", KIND, self._run)
        self.client = TopicActionClient(self.client_node, "client", "/run", KIND)

    def _listen(self, reception: Any) -> None:
        self.told.append({each.goal_id.id: each.status for each in reception.message.status_list})

    def _run(self, goal: Goal) -> Outcome:
        assert isinstance(goal.message, RunInstructionGoal)
        goal.feedback(RunInstructionFeedback(goal.message.instruction, 0.5))
        self.began.release()
        if goal.message.instruction == "fail":
            return Outcome(GOAL_ABORTED, RunInstructionResult(False, "blocked"))
        if goal.message.instruction == "stay":
            assert goal.canceled.wait(WAIT_S)
            return Outcome(GOAL_CANCELED, RunInstructionResult(False, "halfway"))
        return Outcome(GOAL_SUCCEEDED, RunInstructionResult(True, "there"))

    def states(self) -> list[int]:
        """Return the status of the last goal, as it changed."""
        assert self.client_node.settle(WAIT_S)
        name = next(reversed(self.told[-1]))
        found = [each[name] for each in self.told if name in each]
        return [status for index, status in enumerate(found) if not index or status != found[index - 1]]

    def close(self) -> None:
        self.server.close()
        self.robot.close()
        self.client_node.close()


@pytest.fixture
def nodes(request: pytest.FixtureRequest) -> Iterator[Nodes]:
    found = Nodes(request.node.nodeid)
    yield found
    found.close()


def test_types_are_those_that_actionlib_derives() -> None:
    found = types_of(ActionType("actionlib/action/Test", Number, Number, Number)).goal
    assert ros1.type_name(found) == "actionlib/TestActionGoal"
    assert ros1.md5sum(found) == "348369c5b403676156094e8c159720bf"
    message = found(Header(Time(1, 2), "x"), GoalID(Time(3, 4), "name"), Number(7))
    assert same(ros1.decode(found, ros1.encode(message)), message)


def test_a_goal_reports_and_ends(nodes: Nodes) -> None:
    said: list[Message] = []
    outcome = nodes.client.send(RunInstructionGoal("go", 9.0), said.append).result(WAIT_S)
    assert (outcome.status, same(outcome.result, RunInstructionResult(True, "there"))) == (GOAL_SUCCEEDED, True)
    assert same(said[0], RunInstructionFeedback("go", 0.5))
    assert nodes.states()[-2:] == [GoalStatus.ACTIVE, GoalStatus.SUCCEEDED]
    failed = nodes.client.send(RunInstructionGoal("fail"), None).result(WAIT_S)
    assert (failed.status, failed.result.message) == (GOAL_ABORTED, "blocked")  # type: ignore[attr-defined]
    assert nodes.states()[-1] == GoalStatus.ABORTED


def test_a_goal_is_canceled_by_name_by_stamp_with_all_and_by_a_newer_one(nodes: Nodes) -> None:
    named = nodes.client.send(RunInstructionGoal("stay"), None)
    assert nodes.began.acquire(timeout=WAIT_S)
    with pytest.raises(BusError, match="gave no result within 0 s"):
        named.result(0.0)
    nodes.client.cancel(GoalID(Time(1, 0), "somebody"))
    with pytest.raises(BusError, match="gave no result"):
        named.result(0.05)
    named.cancel()
    assert named.result(WAIT_S).status == GOAL_CANCELED
    assert nodes.states()[-3:] == [GoalStatus.ACTIVE, GoalStatus.PREEMPTING, GoalStatus.PREEMPTED]
    for cancel in (GoalID(), GoalID(Time(2**31 - 1, 0))):
        sent = nodes.client.send(RunInstructionGoal("stay"), None)
        assert nodes.began.acquire(timeout=WAIT_S)
        nodes.client.cancel(cancel)
        assert sent.result(WAIT_S).status == GOAL_CANCELED
    first, second = (nodes.client.send(RunInstructionGoal(word), None) for word in ("stay", "go"))
    assert [first.result(WAIT_S).status, second.result(WAIT_S).status] == [GOAL_CANCELED, GOAL_SUCCEEDED]


def test_a_goal_ends_with_its_server_and_none_is_sent_without_one(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = nodes.client.send(RunInstructionGoal("stay"), None)
    assert nodes.began.acquire(timeout=WAIT_S)
    nodes.server.close()
    assert sent.result(WAIT_S).status == GOAL_CANCELED
    nodes.robot.close()
    monkeypatch.setattr(topic_actions, "ANSWER_S", 0.01)
    with pytest.raises(BusError, match="Nobody serves the action /run"):
        nodes.client.send(RunInstructionGoal("go"), None)


def test_a_goal_that_comes_twice_runs_once_and_one_that_ended_is_forgotten(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = types_of(KIND).goal
    send = nodes.client_node.publisher("/run/goal", kind, QoS(depth=10))
    for _ in range(3):
        send(kind(Header(), GoalID(Time(1, 0), "twice"), RunInstructionGoal("go")))
    assert nodes.began.acquire(timeout=WAIT_S)
    assert not nodes.began.acquire(timeout=0.05)
    monkeypatch.setattr(topic_actions, "KEPT_S", 0.0)
    forgotten = threading.Event()
    nodes.client_node.subscribe(
        "/run/status", GoalStatusArray, lambda got: None if got.message.status_list else forgotten.set(), QoS()
    )  # type: ignore[attr-defined]
    assert forgotten.wait(WAIT_S)
