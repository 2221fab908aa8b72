"""Robot controllers as typed: run, replay, topics and sim, and what is refused with which code."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_cli_run import written

from vlatool.bundle.spec import TensorSpec
from vlatool.buses import QoS, open_bus
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header, String
from vlatool.nodes.run_log import RunLog

WEIGHTS = ", ".join(["0.01"] * 14)
PRODUCT = f"g (float[1,7] q) => (float[1,2] y) <float[7,2] w = {{{WEIGHTS}}}> {{ y = MatMul(q, w) }}"
JOINTS = tuple(f"joint{number}" for number in range(1, 8))


@pytest.fixture(scope="module")
def bundle(tmp_path_factory) -> Path:
    action = TensorSpec("y", (1, 2), labels=("forward", "turn"), unit=("m/s", "rad/s"), mode="velocity")
    return written(tmp_path_factory.mktemp("speeds") / "speeds", PRODUCT, action, 50.0).path


@pytest.fixture
def bus(request):
    """Return the address of a bus of this process."""
    return f"sim:{request.node.name}"


@pytest.fixture
def joints(bus):
    """Publish the joints of an arm at 100 Hz, in reverse order; yields the commands that it gets."""
    robot, stop, commands = open_bus(bus, "arm"), threading.Event(), []
    send = robot.publisher("/joint_states", JointState, QoS())
    robot.subscribe("/cmd_vel", Twist, lambda got: commands.append(got.message), QoS(reliable=True, depth=1000))

    def work():
        while not stop.wait(0.01):
            position = np.arange(7, 0, -1) * 0.1
            send(JointState(Header(robot.stamp()), JOINTS[::-1], position + 1e-4 * np.random.default_rng().random(7)))

    thread = threading.Thread(target=work)
    thread.start()
    yield commands
    stop.set()
    thread.join()
    robot.close()


@pytest.fixture
def map_file(vlatool, bundle, tmp_path) -> Path:
    code, out, err = vlatool("run", "policy", "--bundle", bundle, "--print-map")
    assert (code, err) == (0, "")
    assert yaml.safe_load(out)["output"]["elements"] == {"forward": "linear.x", "turn": "angular.z"}
    (tmp_path / "map.yaml").write_text(out)
    return tmp_path / "map.yaml"


def test_any_policy_runs_is_reported_and_replayed(vlatool, bundle, bus, joints, map_file, tmp_path):
    words = ("run", "policy", "--bundle", bundle, "--map", map_file, "--bus", bus, "--threads", 1, "--settle-s", 0,
             "--deadline-ms", 20)  # fmt: skip
    code, out, err = vlatool(*words, "--seconds", 0.5, "--record", tmp_path / "log", "--report", tmp_path / "run.html")
    assert code == 0, err
    assert "vlatool_policy runs: q /joint_states, action /cmd_vel" in err
    assert "steps in 0.5 s" in out
    time.sleep(0.05)
    assert joints[-1].linear.x == 0
    moving = [command for command in joints if command.linear.x]
    assert len(moving) > 15
    assert moving[-1].linear.x == pytest.approx(0.01 * np.arange(1, 8).sum() * 0.1, abs=1e-3)
    assert "Path from above" not in (tmp_path / "run.html").read_text()
    assert "speed commanded" in (tmp_path / "run.html").read_text()
    code, out, err = vlatool("replay", tmp_path / "log", "policy", "--bundle", bundle, "--json")
    assert code == 0, err
    found = json.loads(out)
    assert (found["equal"], found["note"], found["steps"] > 15) == (True, "", True)
    (tmp_path / "other.json").write_text('{"settle_s": 0.2}')
    code, out, err = vlatool(
        "replay", tmp_path / "log", "policy", "--bundle", bundle, "--settings", tmp_path / "other.json"
    )
    assert code == 1
    assert re.search(r"steps differ, the first is \d+, 'action'", out)
    assert "are not computed again as they were" in err


def test_json_of_a_run(vlatool, bus, joints, bundle, map_file):
    code, out, _ = vlatool("run", "policy", "--bundle", bundle, "--map", map_file, "--bus", bus, "--seconds", 0.1,
                           "--threads", 1, "--json")  # fmt: skip
    found = json.loads(out)
    assert (code, found["controller"], found["lost_records"], found["failure"]) == (0, "policy", 0, "")
    assert found["compute_ms"]["samples"] == found["steps"]


def test_a_run_that_is_interrupted_says_what_it_was(vlatool, bus, joints, bundle, map_file):
    words = ("run", "policy", "--bundle", bundle, "--map", map_file, "--bus", bus, "--threads", 1, "--settle-s", 0)
    found = []
    for flags in ((), ("--json",)):
        threading.Timer(0.8, os.kill, (os.getpid(), signal.SIGINT)).start()
        code, out, err = vlatool(*words, *flags)
        assert code == 130, err
        found.append(out)
    assert re.search(r"^\d+ steps in 0\.\d s", found[0])
    document = json.loads(found[1])
    assert document["error"]["type"] == "Interrupted"
    assert document["steps"] > 0


def test_records_that_are_not_whole_and_a_report_that_is_not_written_are_errors_with_the_result(
    vlatool, bus, joints, bundle, map_file, tmp_path, monkeypatch
):
    words = ("run", "policy", "--bundle", bundle, "--map", map_file, "--bus", bus, "--seconds", 0.2, "--threads", 1,
             "--json")  # fmt: skip

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RunLog, "__call__", full)
    code, out, _ = vlatool(*words, "--record", tmp_path / "log", "--report", tmp_path / "run.html")
    found = json.loads(out)
    assert (code, found["error"]["type"]) == (3, "OutputError")
    assert "No space left on device" in found["error"]["message"]
    assert found["steps"] > 0
    assert (tmp_path / "run.html").exists()
    monkeypatch.setattr(Path, "replace", full)
    code, out, _ = vlatool(*words, "--report", tmp_path / "second.html")
    found = json.loads(out)
    assert (code, found["error"]["type"]) == (3, "OutputError")
    assert found["error"]["message"] == f"{tmp_path / 'second.html'} cannot be written: No space left on device."
    assert found["steps"] > 0


def test_topics_lists_what_is_there(vlatool, bus, joints):
    code, out, err = vlatool("topics", "--bus", bus, "--seconds", 0.3)
    assert (code, err) == (0, "")
    assert re.search(r"/cmd_vel +geometry_msgs/msg/Twist .* - -> arm", out)
    assert re.search(r"/joint_states +sensor_msgs/msg/JointState .* Hz .* ms  arm -> -", out)
    code, out, _ = vlatool("topics", "--bus", bus, "--seconds", 0, "--json")
    assert [topic["topic"] for topic in json.loads(out)["topics"]] == ["/cmd_vel", "/joint_states"]


@pytest.mark.parametrize(("name", "path"), [("run.mcap", "run"), ("run.db3", "run"), ("run.bag", "run.bag")])
def test_record_names_the_bag_that_is_there(vlatool, bus, joints, tmp_path, name, path):
    code, out, _ = vlatool(
        "record", "--bus", bus, "-o", tmp_path / name, "--seconds", 0.3, "--json", "/joint_states", "/x"
    )
    found = json.loads(out)
    assert (code, found["file"]) == (0, str(tmp_path / path))
    assert Path(found["file"]).exists()
    assert found["messages"]["/joint_states"] > 3
    assert found["unknown"] == {"/x": "nobody published it"}
    code, out, _ = vlatool("topics", "--bus", f"bag:{tmp_path / path}", "--seconds", 0.1)
    assert out.startswith("/joint_states")


@pytest.mark.parametrize("name", ["", "  ", ".", "a:b"])
def test_record_refuses_what_names_no_bag(vlatool, bus, name):
    code, _, err = vlatool("record", "--bus", bus, "-o", name, "--seconds", 0.1)
    assert code == 2, err


def test_dry_run_of_a_controller(vlatool):
    code, out, err = vlatool("run", "roi-tracker", "--dry-run", "--map", "roi=/face", "--rate", 20)
    assert (code, err) == (0, "")
    assert "roi-tracker at 20 Hz, node vlatool_roi_tracker" in out
    assert re.search(r"input +roi +/face +sensor_msgs/msg/RegionOfInterest", out)


def test_what_roslaunch_adds_names_the_node_and_sets_what_no_flag_sets(vlatool, tmp_path):
    (tmp_path / "settings.json").write_text('{"rate": 15, "x_threshold": 0.2, "gain": 3}')
    code, out, err = vlatool(
        "run", "roi-tracker", "--settings", tmp_path / "settings.json", "--rate", 25, "--dry-run", "--json",
        "_x_threshold:=0.25", "_rate:=20", "/roi:=/face", "__name:=left", "__log:=/tmp/left-1.log",
    )  # fmt: skip
    found = json.loads(out)
    assert code == 0, err
    assert (found["node"], found["rate_hz"]) == ("left", 25)
    assert (found["settings"]["x_threshold"], found["settings"]["gain"]) == (0.25, 3)
    assert "parameters of the node: x_threshold = 0.25, rate = 20" in err


def test_flags_count_before_the_file(vlatool, tmp_path):
    (tmp_path / "settings.json").write_text('{"rate": 15, "x_threshold": 0.2}')
    code, out, _ = vlatool(
        "run", "roi-tracker", "--settings", tmp_path / "settings.json", "--rate", 25, "--dry-run", "--json"
    )
    found = json.loads(out)
    assert (code, found["rate_hz"], found["settings"]["x_threshold"]) == (0, 25, 0.2)


def test_help_lists_controllers_and_their_settings(vlatool):
    _, out, _ = vlatool("run", "--help")
    for name in ("bundle", "policy", "roi-tracker", "vln", "safety-monitor"):
        assert name in out
    _, out, _ = vlatool("run", "vln", "--help")
    assert "--turn-deg" in out
    assert "angle of a turn, in degrees" in out
    assert "Args:" not in out
    _, out, _ = vlatool("run", "roi-tracker", "--help")
    assert "--bundle" not in out


@pytest.fixture
def files(tmp_path, bundle, monkeypatch):
    """Files that command lines of the table below name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bundle").symlink_to(bundle)
    (tmp_path / "there").write_text("x")
    (tmp_path / "run.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "twice.json").write_text('{"rate": 1, "rate": 2}')
    (tmp_path / "unknown.json").write_text('{"rat": 1}')
    (tmp_path / "text.json").write_text('{"rate": "fast"}')
    (tmp_path / "broken.yaml").write_text("inputs: [")
    (tmp_path / "list.yaml").write_text("- 1")
    (tmp_path / "tag.yaml").write_text("!!python/object/apply:os.system ['touch owned']")
    (tmp_path / "empty.yaml").write_text("{}")
    (tmp_path / "latin.yaml").write_bytes(b"inputs: \xff\xfe")
    (tmp_path / "part.yaml").write_text("inputs: {q: {topic: /joint_states, elements: {joint1: a}}}")
    return tmp_path


TRACKER, POLICY = ("run", "roi-tracker", "--bus", "sim"), ("run", "policy", "--bundle", "bundle", "--bus", "sim")
WRONG = [
    (("run", "roi-traker"), 2, "did you mean 'roi-tracker'"),
    (("run", "nothing-like-it", "--dry-run"), 3, "No bundle at nothing-like-it"),
    (("run", "bundle"), 2, "Missing argument"),
    (("run", "./bundle"), 2, "does not say which topics"),
    (("run", "roi-tracker"), 2, "No bus is named"),
    (("run", "roi-tracker", "--bus", "zeno"), 2, "Unknown bus 'zeno'; did you mean 'zenoh'"),
    (("run", "roi-tracker", "--bus", "zenoh:nowhere"), 2, "is not an endpoint"),
    ((*TRACKER, "--node", "a b"), 2, "node"),
    ((*TRACKER, "--rate", "0"), 2, "rate is 0.0; allowed: above 0"),
    ((*TRACKER, "--rate", "nan"), 2, "rate is nan"),
    ((*TRACKER, "--rate", "fast"), 2, "'--rate'"),
    ((*TRACKER, "--rat", "1"), 2, "No such option"),
    ((*TRACKER, "--bundle", "bundle"), 2, "No such option"),
    ((*TRACKER, "--seconds", "-1"), 2, "'--seconds'"),
    ((*TRACKER, "--roi", "1,2,3"), 2, "roi"),
    ((*TRACKER, "--settings", "absent.json"), 3, "absent.json cannot be read: No such file"),
    ((*TRACKER, "--settings", "list.json"), 3, "list, not an object"),
    ((*TRACKER, "--settings", "broken.json"), 3, "is not valid JSON"),
    ((*TRACKER, "--settings", "twice.json"), 3, "the key 'rate' occurs twice"),
    ((*TRACKER, "--settings", "unknown.json"), 2, "has no setting 'rat'; did you mean 'rate'"),
    ((*TRACKER, "--settings", "text.json"), 2, "the setting 'rate' is 'fast'; allowed: a number"),
    ((*TRACKER, "--map", "roi"), 2, "is not of the form NAME=/TOPIC"),
    ((*TRACKER, "--map", "roi="), 2, "is not of the form NAME=/TOPIC"),
    ((*TRACKER, "--map", "ro=/a"), 2, "no topic 'ro' to map; did you mean 'roi'"),
    ((*TRACKER, "--map", "roi=a"), 2, "not the name of a topic"),
    ((*TRACKER, "--map", "roi=/a", "--map", "roi=/b"), 2, "is mapped twice"),
    ((*TRACKER, "--map", "empty.yaml"), 2, "is not of the form NAME=/TOPIC"),
    ((*TRACKER, "--record", "there"), 3, "there exists already"),
    ((*TRACKER, "--report", "there"), 3, "there exists already"),
    ((*TRACKER, "--report", "no/run.html"), 3, "is not a directory"),
    (("run", "vln", "--bus", "sim"), 2, "needs a policy"),
    (("run", "vln", "--bus", "sim", "--bundle", "absent"), 3, "No bundle at absent"),
    (("run", "vln", "--bus", "sim", "--bundle", "bundle"), 2, "of the kind 'tensor'; allowed: discrete"),
    ((*POLICY, "--robot", "r2d2"), 3, "r2d2"),
    (POLICY, 2, "does not say which topic is the input 'q'"),
    ((*POLICY, "--map", "absent.yaml"), 3, "absent.yaml cannot be read"),
    ((*POLICY, "--map", "broken.yaml"), 3, "is not valid YAML"),
    ((*POLICY, "--map", "latin.yaml"), 3, "is not valid YAML"),
    ((*POLICY, "--map", "tag.yaml"), 3, "only plain values are read"),
    ((*POLICY, "--map", "list.yaml"), 3, "must be a mapping"),
    ((*POLICY, "--map", "empty.yaml", "--map", "list.yaml"), 2, "Two maps are named"),
    ((*POLICY, "--map", "part.yaml"), 2, "does not say what is 'joint2'"),
    ((*POLICY, "--deadline-ms", "5000", "--map", "empty.yaml"), 2, "longer than the control period"),
    (("run", "policy", "--print-map"), 2, "none is named"),
    (("run", "policy", "--bus", "sim", "--engine", "abacus", "--bundle", "bundle"), 2, "abacus"),
    ((*TRACKER, "__name:=left", "__log:=/tmp/a"), 2, "'__name:=left __log:=/tmp/a' is for a node of ROS 1"),
    ((*TRACKER, "--ros-args", "-r", "__node:=a"), 2, "is for a node of ROS 2, and the bus is 'sim'"),
    (("run", "roi-tracker", "--bus", "ros2", "__name:=a"), 2, "is for a node of ROS 1, and the bus is 'ros2'"),
    (("run", "roi-tracker", "__name:=a"), 2, "No bus is named"),
    (("run", "roi-tracker", "--dry-run", "_rat:=5"), 2, "has no setting 'rat'; did you mean 'rate'"),
    (("run", "roi-tracker", "--dry-run", "_rate:=fast"), 2, "the setting 'rate' is 'fast'; allowed: a number"),
    (("run", "roi-tracker", "--bus", "ros1", "__nmae:=a"), 2, "ROS 1 has no argument '__nmae'; did you mean '__name'"),
    (("run", "roi-tracker", "--bus", "ros1:http://127.0.0.1:1", "__name:=a"), 3, "No ROS 1 master answers at http://127.0.0.1:1"),
    (("run", "roi-tracker", "--bus", "ros1:127.0.0.1:1", "__master:=127.0.0.1:2"), 2, "Two masters are named"),
    (("run", "bundle", "bundle", "--dry-run", "__name:=a"), 2, "'__name:=a' is for a node of ROS, and a bundle alone"),
    (("sim", "babyai", "--bus", "zenoh", "__name:=a"), 2, "is for a node of ROS 1, and the bus is 'zenoh'"),
    (("record", "--bus", "sim", "-o", "new", "__name:=a"), 2, "is for a node of ROS 1, and the bus is 'sim'"),
    (("record", "bundle", "-o", "new", "__name:=a"), 2, "A bundle is not a node"),
    (("topics", "--bus", "sim", "__name:=a"), 2, "__name:=a"),
    (("topics",), 2, "--bus"),
    (("topics", "--bus", "carrier-pigeon"), 2, "Unknown bus 'carrier-pigeon'"),
    (("sim", "turtlebot5", "--bus", "sim"), 2, "Unknown simulated robot 'turtlebot5'; did you mean 'turtlebot4'"),
    (("sim", "turtlebot4"), 2, "--bus"),
    (("replay", "absent", "roi-tracker"), 3, "There is no recording at absent"),
    (("replay", "run.bag.active", "roi-tracker"), 3, "run.bag.active has no index yet: rosbag record still writes it"),
    (("replay", "there", "roi-tracker"), 3, "there is not a recorded run"),
    (("replay", "there", "bundle", "--settings", "list.json"), 2, "are for a robot controller"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "code", "words"), WRONG, ids=[" ".join(line) for line, _, _ in WRONG])
def test_wrong_command_lines_are_a_sentence_and_a_code(vlatool, files, line, code, words):
    got, out, err = vlatool(*line)
    assert got == code, err
    assert words in " ".join(err.split())
    assert "Traceback" not in err
    assert out == ""
    assert not (files / "owned").exists()


def test_two_publishers_and_another_type_are_refused(vlatool, bus):
    other = open_bus(bus, "teleop")
    other.publisher("/cmd_vel", Twist, QoS())
    code, _, err = vlatool("run", "roi-tracker", "--bus", bus, "--seconds", 0.1)
    assert (code, "/cmd_vel has the publisher teleop already" in err) == (3, True)
    other.publisher("/roi", String, QoS())
    code, _, err = vlatool("run", "roi-tracker", "--bus", bus, "--seconds", 0.1, "--shared")
    assert (code, "/roi carries std_msgs/msg/String" in err) == (3, True)
    other.close()
