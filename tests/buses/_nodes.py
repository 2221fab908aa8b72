"""Claims that hold on every bus over a network; each takes what opens a node on it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from buses._trials import QUALITY, WAIT_S, Heard, forward, speeds, wait_until

from vlatool.buses import (
    GOAL_ABORTED,
    GOAL_CANCELED,
    GOAL_SUCCEEDED,
    ActionBus,
    ActionType,
    Bus,
    Goal,
    Outcome,
    QoS,
    TopicInfo,
)
from vlatool.errors import BusError, UsageError
from vlatool.messages import same
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse, TriggerRequest, TriggerResponse
from vlatool.messages.vlatool_msgs import ACTION, RunInstructionFeedback, RunInstructionGoal, RunInstructionResult

RUN = ActionType(ACTION, RunInstructionGoal, RunInstructionFeedback, RunInstructionResult)
Open = Callable[[str], Bus]


@contextmanager
def opened(open_node: Open, *names: str) -> Iterator[list[Bus]]:
    """Nodes on one bus, closed at the end."""
    nodes: list[Bus] = []
    try:
        nodes += [open_node(name) for name in names]
        yield nodes
    finally:
        for node in reversed(nodes):
            node.close()


class NetworkBus:
    """Tests that each network bus passes; a subclass gives the fixture ``open_node``."""

    def test_messages_pass_both_ways_unchanged(self, open_node: Open) -> None:
        with opened(open_node, "robot", "controller") as (robot, controller):
            seen, commands = Heard(controller, "/image", Image), Heard(robot, "/cmd_vel")
            send_image, send_command = (
                robot.publisher("/image", Image, QUALITY),
                controller.publisher("/cmd_vel", Twist, QUALITY),
            )
            assert robot.wait_for_peers(("/image", "/cmd_vel"), WAIT_S) == ()
            assert controller.wait_for_peers(("/image", "/cmd_vel"), WAIT_S) == ()
            pixels = np.random.default_rng(0).integers(0, 256, 230_400, np.uint8)
            image = Image(height=240, width=320, encoding="rgb8", step=960, data=pixels)
            before = time.monotonic()
            send_image(image)
            assert seen.has(1)
            assert same(seen.messages[0], image)
            assert before <= seen.receptions[0].received_s <= time.monotonic()
            send_command(forward(0.5))
            assert commands.has(1)
            assert speeds(commands.messages) == [0.5]
            assert robot.faults() == controller.faults() == []

    def test_lists_topics_types_and_nodes(self, open_node: Open) -> None:
        with opened(open_node, "robot", "one", "other") as (robot, one, other):
            Heard(robot, "/cmd_vel")
            for node in (one, other):
                node.publisher("/cmd_vel", Twist, QUALITY)
            expected = TopicInfo("/cmd_vel", ("geometry_msgs/msg/Twist",), ("one", "other"), ("robot",))
            for node in (robot, one, other):
                assert wait_until(lambda node=node: expected in node.topics()), node.topics()
            other.close()
            alone = TopicInfo("/cmd_vel", ("geometry_msgs/msg/Twist",), ("one",), ("robot",))
            assert wait_until(lambda: alone in robot.topics()), robot.topics()

    def test_another_type_is_refused_and_counted(self, open_node: Open) -> None:
        with opened(open_node, "robot", "wrong") as (robot, wrong):
            Heard(robot, "/cmd_vel")
            robot.subscribe("/early", Image, lambda _: None, QUALITY)
            assert wait_until(lambda: any(info.topic == "/cmd_vel" for info in wrong.topics()))
            with pytest.raises(
                BusError, match=r"/cmd_vel carries geometry_msgs/msg/Twist \(node robot\), not sensor_msgs"
            ):
                wrong.publisher("/cmd_vel", Image, QUALITY)
            wrong.publisher("/late", Image, QUALITY)
            assert wait_until(lambda: any(info.topic == "/late" for info in robot.topics()))
            with pytest.raises(BusError, match="/late carries sensor_msgs/msg/Image"):
                robot.subscribe("/late", Twist, lambda _: None, QUALITY)

    def test_handler_that_raises_is_counted_and_called_again(self, open_node: Open) -> None:
        with opened(open_node, "robot", "controller") as (robot, controller):
            calls: list[Any] = []

            def handler(reception: Any) -> None:
                calls.append(reception)
                raise ZeroDivisionError("by a bug")

            robot.subscribe("/cmd_vel", Twist, handler, QUALITY)
            send = controller.publisher("/cmd_vel", Twist, QUALITY)
            assert controller.wait_for_peers(("/cmd_vel",), WAIT_S) == ()
            for count in (1, 2):
                assert wait_until(lambda count=count: self._sent(send, calls, count))
            assert wait_until(lambda: [(f.topic, f.count) for f in robot.faults()] == [("/cmd_vel", len(calls))])
            assert "ZeroDivisionError: by a bug" in str(robot.faults()[0].error)

    def test_latched_message_comes_late(self, open_node: Open) -> None:
        latched = QoS(reliable=True, depth=1, latched=True)
        with opened(open_node, "robot", "late") as (robot, late):
            send = robot.publisher("/map_origin", Twist, latched)
            send(forward(1.0))
            send(forward(2.0))
            heard = Heard(late, "/map_origin", qos=latched)
            assert heard.has(1)
            assert speeds(heard.messages) == [2.0]

    def test_slow_handler_gets_the_newest_message(self, open_node: Open) -> None:
        with opened(open_node, "robot", "controller") as (robot, controller):
            heard = Heard(robot, "/cmd_vel", qos=QoS(reliable=True, depth=1), blocks=True)
            counted = Heard(robot, "/cmd_vel", qos=QoS(reliable=True, depth=100))
            send = controller.publisher("/cmd_vel", Twist, QoS(reliable=True, depth=100))
            assert controller.wait_for_peers(("/cmd_vel",), WAIT_S) == ()
            assert wait_until(lambda: self._sent(send, counted.messages, 1))
            assert heard.busy.wait(WAIT_S)
            before = len(counted.messages)
            for speed in range(10, 30):
                send(forward(float(speed)))
            assert wait_until(lambda: len(counted.messages) >= before + 20)
            heard.go.set()
            assert wait_until(lambda: speeds(heard.messages)[-1:] == [29.0])
            assert len(heard.messages) <= 3

    def test_service_answers_refuses_and_is_missed(self, open_node: Open) -> None:
        with opened(open_node, "robot", "caller") as (robot, caller):
            robot.serve("/stop", SetBoolRequest, SetBoolResponse, lambda ask: SetBoolResponse(ask.data, "as asked"))
            robot.serve("/trigger", TriggerRequest, TriggerResponse, lambda _: TriggerResponse(True, "done"))
            for wanted in (True, False):
                answer = caller.call("/stop", SetBoolRequest(wanted), SetBoolResponse, WAIT_S)
                assert (answer.success, answer.message) == (wanted, "as asked")
            assert caller.call("/trigger", TriggerRequest(), TriggerResponse, WAIT_S).message == "done"
            with pytest.raises(BusError, match=r"Nobody served /none within 0.05 s"):
                caller.call("/none", TriggerRequest(), TriggerResponse, 0.05)

    def test_two_requests_are_answered_at_once(self, open_node: Open) -> None:
        both = threading.Barrier(2)

        def handler(ask: Any) -> SetBoolResponse:
            both.wait(WAIT_S)
            return SetBoolResponse(ask.data, "met")

        with opened(open_node, "robot", "caller") as (robot, caller), ThreadPoolExecutor(2) as callers:
            robot.serve("/meet", SetBoolRequest, SetBoolResponse, handler)
            asked = [SetBoolRequest(True), SetBoolRequest(False)]
            calls = [callers.submit(caller.call, "/meet", ask, SetBoolResponse, WAIT_S) for ask in asked]
            assert [call.result().success for call in calls] == [True, False]

    def test_service_that_raises_goes_on(self, open_node: Open) -> None:
        def handler(ask: Any) -> SetBoolResponse:
            if ask.data:
                raise ValueError("motors are off")
            return SetBoolResponse(True, "")

        with opened(open_node, "robot", "caller") as (robot, caller):
            robot.serve("/stop", SetBoolRequest, SetBoolResponse, handler)
            assert caller.call("/stop", SetBoolRequest(False), SetBoolResponse, WAIT_S).success
            with pytest.raises(BusError, match=r"/stop (refused: .*motors are off|did not answer within 0.2 s)"):
                caller.call("/stop", SetBoolRequest(True), SetBoolResponse, 0.2)
            assert wait_until(lambda: [(f.topic, f.count) for f in robot.faults()] == [("/stop", 1)])
            assert caller.call("/stop", SetBoolRequest(False), SetBoolResponse, WAIT_S).success

    def test_action_reports_ends_and_is_canceled(self, open_node: Open) -> None:
        def run(goal: Goal) -> Outcome:
            goal.feedback(RunInstructionFeedback(goal.message.instruction, 0.5))  # type: ignore[attr-defined]
            if goal.message.timeout_s and not goal.canceled.wait(WAIT_S):  # type: ignore[attr-defined]
                return Outcome(GOAL_ABORTED, RunInstructionResult())
            end = GOAL_CANCELED if goal.canceled.is_set() else GOAL_SUCCEEDED
            return Outcome(end, RunInstructionResult(end == GOAL_SUCCEEDED, end))

        with opened(open_node, "robot", "client") as (robot, client):
            assert isinstance(robot, ActionBus)
            assert isinstance(client, ActionBus)
            robot.serve_action("/run_instruction", RUN, run)
            heard: list[Any] = []
            sent = client.send_goal("/run_instruction", RUN, RunInstructionGoal("go"), heard.append)
            outcome = sent.result(WAIT_S)
            assert (outcome.status, outcome.result.success) == (GOAL_SUCCEEDED, True)  # type: ignore[attr-defined]
            waits = client.send_goal("/run_instruction", RUN, RunInstructionGoal("wait", 1.0), heard.append)
            with pytest.raises(BusError, match=r"/run_instruction gave no result within 0.1 s"):
                waits.result(0.1)
            waits.cancel()
            assert waits.result(WAIT_S).status == GOAL_CANCELED
            assert wait_until(lambda: "wait" in [feedback.status for feedback in heard])
            replaced = client.send_goal("/run_instruction", RUN, RunInstructionGoal("wait", 1.0))
            newer = client.send_goal("/run_instruction", RUN, RunInstructionGoal("go"))
            assert replaced.result(WAIT_S).status == GOAL_ABORTED
            assert newer.result(WAIT_S).status == GOAL_SUCCEEDED
            assert robot.faults() == client.faults() == []

    def test_closed_bus_says_so(self, open_node: Open) -> None:
        with opened(open_node, "robot") as (robot,):
            send = robot.publisher("/cmd_vel", Twist, QUALITY)
            robot.close()
            robot.close()
            for act in (lambda: send(forward(1.0)), lambda: Heard(robot, "/odom")):
                with pytest.raises(BusError, match="is closed"):
                    act()

    def test_wrong_names_and_values_are_refused(self, open_node: Open) -> None:
        with opened(open_node, "robot") as (robot,):
            with pytest.raises(UsageError, match="'/cmd vel' cannot be the name of a topic"):
                robot.publisher("/cmd vel", Twist, QUALITY)
            with pytest.raises(BusError, match="Twist"):
                robot.publisher("/cmd_vel", Twist, QUALITY)(Twist(linear="fast"))  # type: ignore[arg-type]
            assert robot.wait_for_peers(("/cmd_vel",), 0.01) == ("/cmd_vel",)
            stamp = robot.stamp()
            assert abs(stamp.seconds - time.time_ns() * 1e-9) < WAIT_S
        with pytest.raises(UsageError, match="'1 node' cannot be the name of a node"):
            open_node("1 node")

    @staticmethod
    def _sent(send: Callable[[Twist], None], heard: list[Any], count: int) -> bool:
        """Send once more until so many have come: the subscriber may be a moment behind in discovering this node."""
        send(forward(0.0))
        return wait_until(lambda: len(heard) >= count, 0.5)
