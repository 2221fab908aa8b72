"""A run from its plan to its summary, over the bus of one process."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from dataclasses import replace
from typing import ClassVar

import pytest

from tests._point_robot import GoTo, PointWorld
from vlatool import registry
from vlatool.buses import QoS, open_bus, split_ros_words
from vlatool.buses._faults import Faults
from vlatool.buses.sim import Sim
from vlatool.errors import BusError, OutputError, UsageError
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.std_msgs import String
from vlatool.nodes import session
from vlatool.nodes.bus_recorder import BusRecorder
from vlatool.nodes.launch import PolicyOptions
from vlatool.nodes.recordings import open_recording
from vlatool.nodes.replay import replay
from vlatool.nodes.report_page import write_page
from vlatool.nodes.run_log import CUT, LogEnd, read_log
from vlatool.nodes.session import RunPlan, dry_run, run_on_bus
from vlatool.nodes.world_node import WorldNode
from vlatool.runtime.telemetry import run_file


@pytest.fixture
def plan(monkeypatch, request):
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda kind, name: GoTo if name == "go-to" else load(kind, name))
    return RunPlan("go-to", {"rate_hz": 50, "goal_x": 0.05, "goal_y": 0}, bus=f"sim:{request.node.name}", seconds=0.6,
                   wait_s=0.3, settle_s=0.0)  # fmt: skip


@pytest.fixture
def world(plan):
    bus = open_bus(plan.bus, "robot")
    node = WorldNode(PointWorld(), bus)
    thread = threading.Thread(target=node.run)
    thread.start()
    yield node.world
    node.stop()
    thread.join()
    bus.close()


def test_run_moves_the_robot_and_its_log_is_replayed(plan, world, tmp_path):
    ended = []
    plan = replace(plan, record=tmp_path / "log", instruction="go there")
    result = run_on_bus(plan, on_end=lambda *what: ended.append(what))
    assert world.truth()["x"] == pytest.approx(0.05, abs=0.04)
    found = result.to_dict()
    assert (found["controller"], found["node"], found["lost_records"], found["failure"]) == (
        "go-to",
        "vlatool_go_to",
        0,
        "",
    )
    assert found["steps"] + found["skipped"] >= 25
    assert ended[0][0] is result
    assert ended[0][1].steps == found["steps"]
    assert ended[0][1].points[-1].notes["seen"] == 1.0
    again = replay(GoTo(**plan.settings), read_log(tmp_path / "log"), None)
    assert (again.equal, again.steps, again.note) == (True, found["steps"], "")
    json.dumps(found, allow_nan=False)


def test_without_a_robot_it_waits_and_says_so(plan):
    with pytest.warns(UserWarning, match="nobody publishes /odom yet"):
        result = run_on_bus(replace(plan, seconds=0.1))
    assert result.summary.status == "waiting for /odom"


def test_a_command_that_nobody_hears_is_said(plan):
    unheard = []
    lonely = replace(plan, seconds=0.1, wait_s=0.0)
    run_on_bus(lonely, on_missing=lambda _: None, on_unheard=unheard.append)
    bus = open_bus(plan.bus, "base")
    bus.subscribe("/cmd_vel", Twist, lambda _: None, QoS())
    run_on_bus(lonely, on_missing=lambda _: None, on_unheard=unheard.append)
    bus.close()
    assert unheard == [("/cmd_vel",)]


def test_refusals_come_before_the_bus(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(session, "open_bus", lambda *_: pytest.fail("the bus was opened"))
    (tmp_path / "there").touch()
    for changes, error, words in (
        ({"bus": ""}, UsageError, "No bus is named"),
        ({"record": tmp_path / "there"}, OutputError, "exists already"),
        ({"report": tmp_path / "there"}, OutputError, "exists already"),
        ({"record": tmp_path / "no" / "log"}, OutputError, "is not a directory"),
        ({"settings": {"goal": 1}}, UsageError, "has no setting 'goal'; did you mean 'goal_y'"),
        ({"settings": {"goal_x": "far"}}, UsageError, "the setting 'goal_x' is 'far'; allowed: a number"),
        ({"settings": {"words": "a"}}, UsageError, "allowed: a list, each text"),
        ({"settings": {"rough": 1}}, UsageError, "allowed: true or false"),
        ({"policy": PolicyOptions(tmp_path)}, UsageError, "takes no policy"),
        ({"controller": "vln", "settings": {}}, UsageError, "needs a policy"),
        ({"controller": "go_too", "settings": {}}, UsageError, "Unknown robot controller 'go_too'"),
    ):
        with pytest.raises(error, match=words):
            run_on_bus(replace(plan, **changes))


def test_an_output_that_would_be_heard_as_an_input_is_refused(plan):
    plan = replace(plan, controller="safety-monitor", settings={}, topics={"safe_cmd_vel": "/cmd_vel"})
    with pytest.raises(UsageError, match="'safe_cmd_vel' is mapped to /cmd_vel, which its input 'cmd_vel' reads"):
        dry_run(plan)


def test_one_file_for_log_and_report_is_refused_before_the_run(plan, tmp_path):
    with pytest.raises(OutputError, match="is named twice"):
        dry_run(replace(plan, record=tmp_path / "." / ".." / tmp_path.name / "same", report=tmp_path / "same"))


def test_a_directory_that_takes_no_file_is_refused_before_the_run(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(session.os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(OutputError, match="not writable"):
        dry_run(replace(plan, report=tmp_path / "run.html"))


def test_a_log_that_cannot_be_written_is_said_after_the_run_and_its_report(plan, world, tmp_path, monkeypatch):
    written, limit, write = [0], 5_000, os.write

    def full(handle, content):
        if written[0] + len(content) > limit:
            raise OSError(errno.ENOSPC, "No space left on device")
        written[0] += len(content)
        return write(handle, content)

    monkeypatch.setattr(run_file.os, "write", full)
    ended = []
    result = run_on_bus(replace(plan, record=tmp_path / "log"), on_end=lambda *what: ended.append(what))
    assert ended
    assert ended[0][0] is result
    assert result.failure == f"{tmp_path / 'log'}: No space left on device"
    assert result.summary.steps > 20
    monkeypatch.undo()
    assert list(read_log(tmp_path / "log"))[-1] == LogEnd(CUT)


def test_refusals_of_the_bus(plan):
    bus = open_bus(plan.bus, "teleop")
    bus.publisher("/cmd_vel", Twist, QoS())
    with pytest.raises(BusError, match="/cmd_vel has the publisher teleop already"):
        run_on_bus(plan)
    bus.publisher("/words", String, QoS())
    with pytest.raises(BusError, match="/words carries std_msgs/msg/String"):
        run_on_bus(replace(plan, shared=True, topics={"odom": "/words"}))
    with pytest.warns(UserWarning, match="nobody"):
        run_on_bus(replace(plan, shared=True, seconds=0.05))
    bus.close()


def test_refused_instruction_leaves_no_log_and_no_thread(plan, tmp_path):
    threads = {thread.name for thread in threading.enumerate()}
    plan = replace(plan, controller="roi-tracker", settings={}, instruction="go", record=tmp_path / "log")
    with pytest.raises(UsageError, match="takes no instruction"):
        run_on_bus(plan)
    assert not plan.record.exists()
    assert {thread.name for thread in threading.enumerate()} <= threads


def test_faults_of_the_bus_are_passed_on_once_and_counted_at_the_end(plan, monkeypatch, tmp_path):
    counted, heard = Faults(), []

    def faulty_bus(*arguments):
        bus = open_bus(*arguments)
        monkeypatch.setattr(bus, "faults", counted.listing)
        return bus

    monkeypatch.setattr(session, "open_bus", faulty_bus)
    for _ in range(2):
        counted.add("/odom", BusError("No messages pass on /odom.", "give both ends one quality of service"))
    page = tmp_path / "page.html"
    watched = replace(plan, seconds=1.2, wait_s=0.0)
    with pytest.warns(UserWarning, match="nobody publishes"):
        result = run_on_bus(watched, on_fault=heard.append, on_end=lambda *run: write_page(page, *run))
    assert [fault.topic for fault in heard] == ["/odom"]
    assert result.to_dict()["faults"] == [
        {"topic": "/odom", "count": 2, "error": "No messages pass on /odom.",
         "fix": "give both ends one quality of service"}
    ]  # fmt: skip
    assert "On the bus, 2 times: No messages pass on /odom." in page.read_text()


def test_dry_run_says_what_would_run(plan):
    found = dry_run(replace(plan, bus="", topics={"odom": "/a"}))
    assert found["rate_hz"] == 50
    assert found["inputs"][0] == {"name": "odom", "topic": "/a", "type": "nav_msgs/msg/Odometry"}
    assert found["services"] == [{"name": "halt", "topic": "/halt", "type": "std_msgs/msg/Bool"}]
    assert found["settings"]["goal_x"] == 0.05


class LaunchedBus(Sim):
    """A node of a bus whose library remaps topics, as rospy and rclpy do: two of them are swapped."""

    SWAPPED: ClassVar = {"/odom": "/base/odom", "/base/odom": "/odom", "/cmd_vel": "/base/cmd_vel"}

    def __init__(self, address, node, words=None):
        super().__init__(address, "left" if words else node)
        self.full_node = "robot1/left" if words else node
        self.swapped = self.SWAPPED if words else {}

    def resolve(self, name):
        return self.swapped.get(name, name)

    def subscribe(self, topic, message, handler, qos):
        super().subscribe(self.resolve(topic), message, handler, qos)

    def publisher(self, topic, message, qos):
        return super().publisher(self.resolve(topic), message, qos)

    def wait_for_peers(self, topics, timeout_s):
        alone = super().wait_for_peers(tuple(map(self.resolve, topics)), timeout_s)
        return tuple(topic for topic in topics if self.resolve(topic) in alone)


def test_first_step_waits_for_the_recorders_of_the_bus(plan, monkeypatch):
    load = registry.load
    monkeypatch.setattr("vlatool.buses._interface.load",
                        lambda kind, name: LaunchedBus if kind == "buses" else load(kind, name))  # fmt: skip
    monkeypatch.setattr(LaunchedBus, "settle_s", 0.4, raising=False)
    times = []
    plan = replace(plan, settle_s=None, wait_s=0.0, seconds=0.0)
    run_on_bus(plan, lambda about: times.append(time.monotonic()), lambda *_: times.append(time.monotonic()), print)
    assert 0.4 <= times[1] - times[0] < 2.0


def test_node_of_a_launch_file_is_recorded_under_the_names_that_the_bus_has(plan, monkeypatch, tmp_path):
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda kind, name: LaunchedBus if name == "ros1" else load(kind, name))
    monkeypatch.setattr("vlatool.buses._interface.load", registry.load)
    _, words = split_ros_words(["__name:=left", "/odom:=/base/odom"])
    plan = replace(plan, bus=plan.bus.replace("sim:", "ros1:"), words=words, seconds=0.2, wait_s=0.0)
    other = open_bus(plan.bus, "teleop")
    other.publisher("/cmd_vel", Twist, QoS())
    bag = open_bus(f"bag::{tmp_path / 'run'}", "recorder")
    recorder = BusRecorder(other, bag, "recorder")
    thread = threading.Thread(target=recorder.run)
    thread.start()
    said = []
    result = run_on_bus(replace(plan, settle_s=0.3), on_missing=said.append)
    recorder.stop()
    thread.join()
    bag.close()
    assert (result.about.node, said) == ("robot1/left", [("/base/odom",)])
    assert (result.about.topics["odom"], result.about.topics["cmd"]) == ("/base/odom", "/base/cmd_vel")
    found = open_recording(tmp_path / "run", "go-to", "/robot1/left")
    assert replay(GoTo(**plan.settings), found.items(), found.topics).unheard == 0
    other.publisher("/base/cmd_vel", Twist, QoS())
    with pytest.raises(BusError, match="/base/cmd_vel has the publisher teleop already"):
        run_on_bus(plan)
    other.close()
