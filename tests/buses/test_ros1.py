"""Without ROS 1: addresses, masters that answer or do not, an absent rospy; tests/validation/robots has the rest."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest

from vlatool.buses import TopicInfo, launch_parameters, open_bus, split_ros_words
from vlatool.buses._ros1_master import DEFAULT, Master, ask, master_uri, own_address
from vlatool.errors import BusError, MissingExtra, UsageError
from vlatool.messages.geometry_msgs import Twist

STATE = [
    [["/cmd_vel", ["/robot", "/other"]], ["/scan", ["/laser"]]],
    [["/cmd_vel", ["/base"]], ["/odd", ["/base"]]],
    [["/set", ["/robot"]]],
]
TYPES = [["/cmd_vel", "geometry_msgs/Twist"], ["/scan", "sensor_msgs/LaserScan"], ["/odd", "*"], ["/gone", "a/B"]]


class Quiet(SimpleXMLRPCRequestHandler):
    """Writes no log."""

    def log_message(self, format: str, *arguments: Any) -> None:
        pass


@pytest.fixture
def master() -> Iterator[Master]:
    """A server with a master's answers."""
    nodes: dict[str, str] = {}
    with SimpleXMLRPCServer(("127.0.0.1", 0), Quiet, allow_none=True) as server:
        uri = f"http://127.0.0.1:{server.server_address[1]}"
        nodes["/robot"] = uri
        nodes["/killed"] = "http://127.0.0.1:1"
        server.register_function(lambda caller: [1, "", STATE], "getSystemState")
        server.register_function(lambda caller: [1, "", TYPES], "getTopicTypes")
        server.register_function(lambda caller: [1, "", 7], "getPid")
        server.register_function(
            lambda caller, name: [1, "", nodes[name]] if name in nodes else [-1, "unknown node", 0], "lookupNode"
        )
        server.register_function(
            lambda caller, name: [1, "", uri.replace("http", "rosrpc")] if name == "/set" else [-1, "", 0],
            "lookupService",
        )
        server.register_function(
            lambda caller, name: [1, "", {"rate": 5}] if name == "/ns/left" else [-1, "not set", 0], "getParam"
        )
        server.register_function(lambda caller: "no answer of a master", "odd")
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield Master(uri, "/node")
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("address", "uri"),
    [
        ("http://robot:11311", "http://robot:11311"),
        ("robot:11312", "http://robot:11312"),
        ("http://[::1]:11311/", "http://[::1]:11311/"),
        ("", DEFAULT),
    ],
)
def test_an_address_is_that_of_a_master(monkeypatch: pytest.MonkeyPatch, address: str, uri: str) -> None:
    monkeypatch.delenv("ROS_MASTER_URI", raising=False)
    assert master_uri(address) == uri
    monkeypatch.setenv("ROS_MASTER_URI", "http://elsewhere:1")
    assert master_uri("") == "http://elsewhere:1"


@pytest.mark.parametrize(
    "address", ["11311", "robot", "ftp://robot:1", "http://robot:x", "http://:1", "http://a:99999", "[:1"]
)
def test_another_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="is not the address of a ROS 1 master; it has a host and a port"):
        master_uri(address)


def test_nodes_on_other_machines_get_an_address_that_they_reach() -> None:
    assert own_address("http://127.0.0.1:11311") == own_address("http://localhost:11311") == "127.0.0.1"
    assert own_address("http://no-such-host.invalid:11311") == ""


def test_topics_have_ros_2_names_of_types_and_all_publishers(master: Master) -> None:
    assert master.topics() == [
        TopicInfo("/cmd_vel", (Twist.TYPE,), ("/robot", "/other"), ("/base",)),
        TopicInfo("/odd", (), (), ("/base",)),
        TopicInfo("/scan", ("sensor_msgs/msg/LaserScan",), ("/laser",), ()),
    ]


def test_another_type_is_refused_with_both_names(master: Master) -> None:
    words = r"/cmd_vel carries geometry_msgs/msg/Twist, not std_msgs/msg/Bool; it is used by /base, /other, /robot"
    with pytest.raises(BusError, match=words):
        master.refuse_other_type("/cmd_vel", "std_msgs/msg/Bool")
    for topic in ("/cmd_vel", "/odd", "/new"):
        master.refuse_other_type(topic, Twist.TYPE)
    Master(master.uri, "/laser").refuse_other_type("/scan", Twist.TYPE)


def test_a_living_node_of_the_same_name_and_a_second_server_are_refused(master: Master) -> None:
    with pytest.raises(BusError, match=r"name /robot runs on this master already(?s:.*)rosnode kill /robot"):
        Master(master.uri, "/robot").refuse_namesake()
    for name in ("/killed", "/new"):
        Master(master.uri, name).refuse_namesake()
    with pytest.raises(BusError, match="/set is served already"):
        master.refuse_second_server("/set")
    master.refuse_second_server("/other")


def test_parameters_of_a_launch_file_are_those_below_the_name_of_the_node(master: Master) -> None:
    named, other = (split_ros_words([f"__name:={name}", "__ns:=/ns", "_turn:=2"])[1] for name in ("left", "right"))
    assert named is not None
    assert other is not None
    assert launch_parameters(f"ros1:{master.uri}", "n", named) == {"rate": 5, "turn": 2}
    assert launch_parameters(f"ros1:{master.uri}", "n", other) == {"turn": 2}
    with pytest.raises(BusError, match="No ROS 1 master answers"):
        launch_parameters("ros1:127.0.0.1:1", "n", named)
    with pytest.raises(UsageError, match="Two masters are named"):
        launch_parameters("ros1:127.0.0.1:1", "n", split_ros_words(["__master:=127.0.0.1:2"])[1])  # type: ignore[arg-type]


def test_what_is_no_master_is_told_at_once(master: Master) -> None:
    for method in ("odd", "absent"):
        with pytest.raises(BusError, match=r"What answers at .* is not a ROS 1 master"):
            master.ask(method)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        uri = f"http://127.0.0.1:{mute.getsockname()[1]}"
        with pytest.raises(BusError, match=r"nobody answered within 0\.1 s(?s:.*)roscore"):
            ask(uri, "getPid", "/node", timeout_s=0.1)
    with pytest.raises(BusError, match=r"No ROS 1 master answers at .*: connection refused"):
        ask(uri, "getPid", "/node")


@pytest.mark.parametrize(
    "content", [b"SSH-2.0-x\r\n", b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\n<a>", b"HTTP/1.1 404 No\r\n\r\n"]
)
def test_another_server_is_no_master(content: bytes) -> None:
    def answer() -> None:
        connection, _ = server.accept()
        connection.recv(65536)
        connection.sendall(content)
        connection.close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(BusError, match=f"127.0.0.1:{server.getsockname()[1]}"):
            ask(f"http://127.0.0.1:{server.getsockname()[1]}", "getPid", "/node", timeout_s=5.0)
        thread.join()


def test_an_absent_rospy_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(MissingExtra, match=r"'rospy' is not installed(?s:.*)apt-get install python3-rospy"):
        open_bus("ros1", "node")


def test_a_part_of_rospy_that_is_absent_is_named(tmp_path: Any) -> None:
    (tmp_path / "rospy.py").write_text("import rosgraph_of_nobody\n")
    code = "from vlatool.buses import open_bus\ntry:\n    open_bus('ros1', 'n')\nexcept Exception as e:\n    print(e)"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{code}"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "'rosgraph_of_nobody', which rospy needs, is not installed" in done.stdout
