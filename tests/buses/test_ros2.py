"""Against a double with rclpy's documented interface: no rclpy is on PyPI or in Debian."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from typing import Any

import _rclpy_double as double
import numpy as np
import pytest
from buses._trials import wait_until

from vlatool.buses import (
    GOAL_ABORTED,
    GOAL_CANCELED,
    GOAL_SUCCEEDED,
    ActionBus,
    ActionType,
    Goal,
    NamingBus,
    Outcome,
    QoS,
    Reception,
    TopicInfo,
    open_bus,
    ros2,
    split_ros_words,
)
from vlatool.buses._rclpy_messages import from_ros, to_ros
from vlatool.buses.ros2 import Ros2
from vlatool.cli import main
from vlatool.errors import BusError, MissingExtra, UsageError
from vlatool.messages import Message, find_type, same
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.diagnostic_msgs import DiagnosticArray, DiagnosticStatus, KeyValue
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import CameraInfo, Image, JointState, LaserScan, PointCloud2, PointField
from vlatool.messages.std_msgs import Bool, Header, String
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse
from vlatool.messages.trajectory_msgs import JointTrajectory, JointTrajectoryPoint
from vlatool.messages.vlatool_msgs import (
    ACTION,
    RunInstructionFeedback,
    RunInstructionGoal,
    RunInstructionResult,
)

KIND = ActionType(ACTION, RunInstructionGoal, RunInstructionFeedback, RunInstructionResult)
WAIT_S = 10.0
Nodes = Callable[[str], Ros2]


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> double.Graph:
    monkeypatch.setattr(ros2, "DISCOVERY_S", 0.0)
    return double.install(monkeypatch)


@pytest.fixture
def node(graph: double.Graph) -> Iterator[Nodes]:
    opened: list[Ros2] = []

    def open_node(name: str) -> Ros2:
        opened.append(Ros2("", name))
        return opened[-1]

    yield open_node
    for bus in opened:
        bus.close()


class Inbox:
    """Receptions, which may be waited for."""

    def __init__(self) -> None:
        self.got: list[Reception] = []
        self._more = threading.Condition()

    def put(self, reception: Reception) -> None:
        with self._more:
            self.got.append(reception)
            self._more.notify_all()

    def wait(self, count: int) -> list[Message]:
        with self._more:
            assert self._more.wait_for(lambda: len(self.got) >= count, WAIT_S)
        return [each.message for each in self.got]


def examples() -> list[Message]:
    draw = np.random.default_rng(1)
    numbers = draw.normal(size=36)
    header = Header(Time(3, 4), "base_link")
    point = JointTrajectoryPoint(positions=numbers[:6])
    return [
        Twist(Vector3(float("nan"), -0.0, 5e-324), Vector3(float("inf"), 1.0, -1.0)),
        Image(header, 2, 3, "rgb8", 0, 9, draw.integers(0, 256, 18, np.uint8)),
        LaserScan(header, ranges=numbers.astype(np.float32)),
        JointState(header, ("a", "ü"), numbers[:2]),
        CameraInfo(header, d=numbers[:5], k=numbers[:9], p=numbers[:12]),
        PointCloud2(header, 1, 2, (PointField("x", 0, 7, 1), PointField("y", 4, 7, 1)), data=np.zeros(16, np.uint8)),
        JointTrajectory(header, ("a", "b"), (point, JointTrajectoryPoint())),
        DiagnosticArray(header, (DiagnosticStatus(2, "motor", "hot", "7", (KeyValue("t", "90"),)),)),
        Odometry(),
        Image(),
    ]


@pytest.mark.parametrize("message", examples(), ids=lambda each: type(each).__name__)
def test_a_message_survives_the_classes_of_rclpy_bit_for_bit(graph: double.Graph, message: Message) -> None:
    assert same(from_ros(type(message), to_ros(message)), message)


def test_each_type_that_ros_2_has_converts(graph: double.Graph) -> None:
    from vlatool.messages.schema import _TYPES

    packages = (
        "geometry_msgs",
        "sensor_msgs",
        "std_msgs",
        "nav_msgs",
        "trajectory_msgs",
        "diagnostic_msgs",
        "tf2_msgs",
    )
    names = [name for name in _TYPES if name.split("/")[0] in packages]
    assert len(names) > 30
    for name in names:
        kind: Any = find_type(name)
        assert same(from_ros(kind, to_ros(kind())), kind()), name


def test_a_value_or_a_definition_that_does_not_fit_is_named(graph: double.Graph) -> None:
    with pytest.raises(BusError, match=r"'height' of sensor_msgs/msg/Image does not fit.*must be a uint32"):
        to_ros(Image(height=-1))
    theirs = to_ros(Bool(True))
    with pytest.raises(BusError, match="'linear' of geometry_msgs/msg/Twist does not fit"):
        from_ros(Twist, theirs)


def test_messages_pass_with_ros_2s_quality_of_service(node: Nodes, graph: double.Graph) -> None:
    robot, controller = node("robot"), node("controller")
    assert isinstance(robot, ActionBus)
    inbox, silent = Inbox(), Inbox()
    controller.subscribe("/scan", LaserScan, inbox.put, QoS())
    controller.subscribe("/scan", LaserScan, silent.put, QoS(reliable=True, depth=7, latched=True))
    send = robot.publisher("scan", LaserScan, QoS(depth=3))
    sent = [LaserScan(ranges=np.full(360, index, np.float32)) for index in range(5)]
    for message in sent:
        send(message)
    assert all(same(one, other) for one, other in zip(inbox.wait(5), sent, strict=True))
    assert not silent.got
    profiles = [end.profile for each in graph.nodes for end in (*each.subscriptions, *each.publishers)]
    assert [(each.depth, each.reliability.name, each.durability.name) for each in profiles] == [
        (3, "BEST_EFFORT", "VOLATILE"),
        (1, "BEST_EFFORT", "VOLATILE"),
        (7, "RELIABLE", "TRANSIENT_LOCAL"),
    ]
    assert graph.signals == [double.SignalHandlerOptions.NO] * 2
    assert robot.stamp().seconds == Time(12, 34).seconds


def test_topics_types_and_peers(node: Nodes) -> None:
    one, two, robot = node("one"), node("two"), node("robot")
    robot.subscribe("/cmd_vel", Twist, lambda each: None, QoS())
    assert robot.wait_for_peers(("/cmd_vel", "/scan"), 0.0) == ("/cmd_vel", "/scan")
    for bus in (one, two):
        bus.publisher("/cmd_vel", Twist, QoS())
    assert robot.wait_for_peers(("/cmd_vel",), WAIT_S) == ()
    assert one.topics() == [TopicInfo("/cmd_vel", (Twist.TYPE,), ("/one", "/two"), ("/robot",))]
    with pytest.raises(BusError, match=r"/cmd_vel carries geometry_msgs/msg/Twist, not std_msgs/msg/String.*by /one"):
        two.subscribe("/cmd_vel", String, lambda each: None, QoS())
    with pytest.raises(BusError, match="/cmd_vel carries geometry_msgs/msg/Twist, not std_msgs/msg/String"):
        two.publisher("cmd_vel", String, QoS())


def test_a_launch_file_names_the_node_and_swaps_two_topics(graph: double.Graph) -> None:
    _, words = split_ros_words(["--ros-args", "-r", "__node:=left", "-r", "__ns:=/robot1", "-r", "/cmd_vel:=safe",
                                "-r", "/safe:=/cmd_vel", "-r", "~/state:=/state", "-r", "set:=/set"])  # fmt: skip
    robot, bus, inbox = Ros2("", "robot"), Ros2("", "vlatool_vln", words), Inbox()
    assert isinstance(bus, NamingBus)
    assert (bus.node, bus.full_node) == ("left", "robot1/left")
    robot.subscribe("/robot1/safe", Twist, inbox.put, QoS())
    robot.publisher("/cmd_vel", String, QoS())
    bus.publisher("/cmd_vel", Twist, QoS())(Twist(Vector3(1.0)))
    assert same(inbox.wait(1)[0], Twist(Vector3(1.0)))
    with pytest.raises(BusError, match="/cmd_vel carries std_msgs/msg/String, not geometry_msgs/msg/Twist"):
        bus.subscribe("/safe", Twist, inbox.put, QoS())
    assert [bus.resolve(name) for name in ("scan", "~state", "~other", "/scan")] == [
        "/robot1/scan", "/state", "/robot1/left/other", "/scan",
    ]  # fmt: skip
    assert bus.wait_for_peers(("/cmd_vel", "/safe"), WAIT_S) == ()
    bus.serve("set", SetBoolRequest, SetBoolResponse, lambda request: SetBoolResponse(True, "here"))
    assert robot.call("/set", SetBoolRequest(), SetBoolResponse, WAIT_S).message == "here"
    for each in (robot, bus):
        each.close()


def test_a_latched_message_reaches_who_comes_later(node: Nodes) -> None:
    robot, late, inbox = node("robot"), node("late"), Inbox()
    robot.publisher("/map", String, QoS(reliable=True, latched=True))(String("walls"))
    late.subscribe("/map", String, inbox.put, QoS(reliable=True, latched=True))
    assert same(inbox.wait(1)[0], String("walls"))


def test_a_malformed_message_and_a_failing_handler_end_nothing(node: Nodes) -> None:
    robot, controller, inbox = node("robot"), node("controller"), Inbox()

    def handle(reception: Reception) -> None:
        inbox.put(reception)
        raise ValueError("no")

    controller.subscribe("/say", String, handle, QoS())
    send = robot.publisher("/say", String, QoS())
    controller._executor.create_task(controller._node.subscriptions[0].callback, object())
    send(String("go"))
    send(String("on"))
    inbox.wait(2)
    robot.close()
    controller.close()
    (fault,) = controller.faults()
    assert (fault.topic, fault.count) == ("/say", 3)
    assert fault.error.message == "The handler of /say raised ValueError: no."
    for attempt in (lambda: send(String()), lambda: robot.topics(), lambda: robot.serve_action("/a", KIND, print)):  # type: ignore[arg-type]
        with pytest.raises(BusError, match="has left the bus"):
            attempt()


def test_a_service_is_answered_while_topics_are_heard(node: Nodes) -> None:
    robot, monitor, inbox = node("robot"), node("monitor"), Inbox()
    go_on = threading.Event()
    monitor.subscribe("/say", String, inbox.put, QoS())

    def answer(request: Message) -> SetBoolResponse:
        assert isinstance(request, SetBoolRequest)
        robot.publisher("/say", String, QoS())(String("while it is answered"))
        inbox.wait(1)
        if not request.data:
            assert go_on.wait(WAIT_S)
            raise ValueError("no")
        return SetBoolResponse(True, "ü")

    monitor.serve("/set", SetBoolRequest, SetBoolResponse, answer)
    assert same(robot.call("set", SetBoolRequest(True), SetBoolResponse, WAIT_S), SetBoolResponse(True, "ü"))
    with pytest.raises(BusError, match=r"no answer within 0\.05 s"):
        robot.call("/set", SetBoolRequest(False), SetBoolResponse, 0.05)
    go_on.set()
    assert same(robot.call("/set", SetBoolRequest(False), SetBoolResponse, WAIT_S), SetBoolResponse())
    assert wait_until(lambda: [(each.topic, each.count) for each in monitor.faults()] == [("/set", 2)])
    with pytest.raises(BusError, match=r"Nobody has served /none within 0\.01 s"):
        robot.call("/none", SetBoolRequest(), SetBoolResponse, 0.01)


def test_an_action_reports_ends_and_is_canceled(node: Nodes) -> None:
    robot, client = node("robot"), node("client")
    began = threading.Semaphore(0)

    def run(goal: Goal) -> Outcome:
        assert isinstance(goal.message, RunInstructionGoal)
        goal.feedback(RunInstructionFeedback(goal.message.instruction, 0.5))
        began.release()
        if goal.message.instruction == "go":
            return Outcome(GOAL_SUCCEEDED, RunInstructionResult(True, "there"))
        assert goal.canceled.wait(WAIT_S)
        return Outcome(GOAL_CANCELED, RunInstructionResult(False, "halfway"))

    with pytest.raises(BusError, match="Nobody serves the action /run"):
        client.send_goal("/run", KIND, RunInstructionGoal())
    robot.serve_action("/run", KIND, run)
    said: list[Message] = []
    outcome = client.send_goal("/run", KIND, RunInstructionGoal("go", 9.0), said.append).result(WAIT_S)
    assert (outcome.status, same(outcome.result, RunInstructionResult(True, "there"))) == (GOAL_SUCCEEDED, True)
    assert same(said[0], RunInstructionFeedback("go", 0.5))
    asked, replaced = (client.send_goal("/run", KIND, RunInstructionGoal(word)) for word in ("stay", "wait"))
    assert asked.result(WAIT_S).status == GOAL_ABORTED
    replaced.cancel()
    assert replaced.result(WAIT_S).status == GOAL_CANCELED
    with pytest.raises(BusError, match="no result within 0 s"):
        client.send_goal("/run", KIND, RunInstructionGoal("stay")).result(0.0)


@pytest.mark.parametrize("address", ["233", "-1", "x", "1.5", "٣"])
def test_an_impossible_domain_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="is not a whole number from 0 to 232"):
        open_bus(f"ros2:{address}", "node")


def test_absent_packages_are_named(graph: double.Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    modules = __import__("sys").modules
    monkeypatch.setitem(modules, "geometry_msgs.msg", None)
    with pytest.raises(
        MissingExtra, match=r"geometry_msgs, which is not installed(?s:.*)ros-\$ROS_DISTRO-geometry-msgs"
    ):
        to_ros(Twist())
    monkeypatch.setitem(modules, "vlatool_msgs.action", None)
    with pytest.raises(MissingExtra, match="docs/guides/buses"):
        to_ros(RunInstructionGoal())
    monkeypatch.setitem(modules, "rclpy", None)
    with pytest.raises(MissingExtra, match="'rclpy' cannot be imported"):
        open_bus("ros2", "node")


def test_a_controller_of_a_launch_file_runs_under_its_names(graph: double.Graph, capsys, tmp_path) -> None:
    (tmp_path / "parameters.yaml").write_text("/robot1/left: {ros__parameters: {rate: 40, use_sim_time: false}}")
    words = ["run", "roi-tracker", "--bus", "ros2", "--seconds", "0.2", "--wait", "0", "--json", "--ros-args", "-r",
             "__node:=left", "-r", "__ns:=/robot1", "--params-file", str(tmp_path / "parameters.yaml"), "-p",
             "gain:=2.5", "-r", "/cmd_vel:=cmd_vel", "-r", "/odd:=/even"]  # fmt: skip
    with pytest.raises(SystemExit) as end:
        main(words)
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert (end.value.code, found["node"], found["topics"]["cmd_vel"]) == (0, "robot1/left", "/robot1/cmd_vel")
    assert found["steps"] == 8
    assert "parameters of the node: rate = 40, gain = 2.5" in err
    assert "the remapping /odd:=/even changes no topic of this node" in err
    assert "/cmd_vel:=cmd_vel changes no topic" not in err
