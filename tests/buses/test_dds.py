"""Nodes in a DDS domain: what every bus does, and what ROS 2's middlewares on DDS ask for."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from buses._nodes import NetworkBus, Open, opened
from buses._trials import QUALITY, WAIT_S, Heard, forward, speeds, wait_until

from vlatool.buses import Bus, QoS, TopicInfo, open_bus
from vlatool.buses._dds_types import describe, describe_service_part
from vlatool.errors import BusError, MissingExtra, UsageError
from vlatool.messages import Message
from vlatool.messages.cdr import HEADER, encode
from vlatool.messages.geometry_msgs import Twist, TwistStamped
from vlatool.messages.schema import find_type
from vlatool.messages.sensor_msgs import CameraInfo, Image, JointState, PointCloud2
from vlatool.messages.std_srvs import SetBoolRequest, TriggerRequest
from vlatool.messages.type_hash import rihs01

pytest.importorskip("cyclonedds")
DOMAIN = 100 + os.getpid() % 100
"""A domain of this process, so that tests that run at once do not meet."""


@pytest.fixture
def open_node() -> Open:
    def open_one(name: str) -> Bus:
        return open_bus(f"dds:{DOMAIN}@127.0.0.1", name)

    return open_one


PUBLISHER = """
import sys
from vlatool.buses import QoS, open_bus
from vlatool.messages.geometry_msgs import Twist
bus = open_bus(sys.argv[1], "other")
send = bus.publisher("/cmd_vel", Twist, QoS(reliable=False))
bus.wait_for_peers(("/cmd_vel",), 10.0)
print(bus._graph._writers[-1].hex(), flush=True)
for _ in sys.stdin:
    send(Twist())
bus.close()
"""


@contextmanager
def publishing_process() -> Iterator[Callable[[], bytes]]:
    """Another process with a publisher of /cmd_vel; gives what lets it send one message and returns its identifier."""
    command = [sys.executable, "-c", PUBLISHER, f"dds:{DOMAIN}@127.0.0.1"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin
        assert process.stdout
        sends, tells = process.stdin, process.stdout

        def meet() -> bytes:
            identifier = bytes.fromhex(tells.readline())
            sends.write("send\n")
            sends.flush()
            return identifier

        try:
            yield meet
        finally:
            sends.close()
            process.wait(WAIT_S)


def send_rtps(writer: bytes, number: int, payload: bytes) -> None:
    """Send a message in the name of a writer to every participant that may be on this machine (RTPS 2.1, DATA)."""
    head = b"RTPS" + bytes((2, 1, 1, 16)) + writer[:12]
    data = struct.pack("<HH4s4siI", 0, 16, bytes(4), writer[12:], 0, number) + payload
    packet = head + struct.pack("<BBH", 0x15, 0x05, len(data)) + data
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for index in range(8):
            sender.sendto(packet, ("127.0.0.1", 7400 + 250 * DOMAIN + 11 + 2 * index))


class TestDds(NetworkBus):
    """What every network bus does."""

    def test_malformed_messages_on_the_wire_are_counted(self, open_node: Open) -> None:
        with opened(open_node, "robot") as (robot,), publishing_process() as meet:
            heard = Heard(robot, "/cmd_vel", qos=QoS(reliable=False))
            writer = meet()
            assert heard.has(1)
            for number, payload in enumerate((b"", bytes(3), encode(Twist())[4:40]), 1_000_000):
                send_rtps(writer, number, HEADER + payload)
            assert wait_until(lambda: [(f.topic, f.count) for f in robot.faults()] == [("/cmd_vel", 3)])
            assert "A malformed geometry_msgs/msg/Twist came on /cmd_vel" in str(robot.faults()[0].error)
            send_rtps(writer, 2_000_000, encode(forward(7.0)))
            assert wait_until(lambda: speeds(heard.messages)[-1] == 7.0)

    def test_endpoints_state_names_hash_and_enclave(self, open_node: Open) -> None:
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.domain import DomainParticipant

        with opened(open_node, "robot") as (robot,):
            robot.publisher("/cmd_vel", Twist, QUALITY)
            other = DomainParticipant(DOMAIN)
            reader, found = BuiltinDataReader(other, BuiltinTopicDcpsPublication), {}
            assert wait_until(
                lambda: bool(found.update({s.topic_name: s for s in reader.take(100)}) or "rt/cmd_vel" in found)
            )
            endpoint = found["rt/cmd_vel"]
            assert endpoint.type_name == "geometry_msgs::msg::dds_::Twist_"
            assert f"typehash={rihs01(Twist)};" in repr(endpoint.qos)
            assert "ros_discovery_info" in found
            other._delete(other._ref)

    def test_quality_that_does_not_match_is_a_fault(self, open_node: Open) -> None:
        with opened(open_node, "robot", "controller") as (robot, controller):
            Heard(robot, "/cmd_vel", qos=QoS(reliable=True))
            controller.publisher("/cmd_vel", Twist, QoS(reliable=False))
            expected = "between this node and robot: the subscriber asks for 'reliable'"
            assert wait_until(lambda: expected in "".join(str(fault.error) for fault in controller.faults()))
            robot.close()
            assert wait_until(lambda: not any(info.subscribers for info in controller.topics()))
            assert expected in str(controller.faults()[0].error)

    def test_endpoint_that_cyclonedds_fails_to_build_hides_no_other(
        self, open_node: Open, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from cyclonedds import builtin

        build, failures = builtin.endpoint_constructor, []

        def fail_at_first(*arguments: object) -> object:
            if len(failures) < 3:
                failures.append(arguments)
                raise ValueError("no endpoint")
            return build(*arguments)

        with opened(open_node, "robot") as (robot,):
            robot.publisher("/say", Twist, QUALITY)
            monkeypatch.setattr(builtin, "endpoint_constructor", fail_at_first)
            with opened(open_node, "controller") as (controller,):
                listed = TopicInfo("/say", (Twist.TYPE,), ("robot",), ())
                assert wait_until(lambda: listed in controller.topics()), controller.topics()
                assert len(failures) == 3

    def test_names_of_all_nodes_are_heard_however_late_this_node_listens(self, open_node: Open) -> None:
        with opened(open_node, "robot") as (robot,), robot._graph._changed:  # whoever hears a name waits for this
            names = [f"node_{count}" for count in range(6)]
            with opened(open_node, *names) as nodes:
                for node in nodes:
                    node.publisher("/say", Twist, QUALITY)
                time.sleep(0.5)
                robot._graph._changed.release()
                try:
                    wait_until(lambda: any(info.publishers == tuple(names) for info in robot.topics()))
                    assert [info.publishers for info in robot.topics() if info.topic == "/say"] == [tuple(names)]
                finally:
                    robot._graph._changed.acquire()

    def test_one_process_uses_a_domain_on_one_interface(self, open_node: Open) -> None:
        with (
            opened(open_node, "robot"),
            pytest.raises(BusError, match=f"Domain {DOMAIN} is open in this process on '127"),
        ):
            open_bus(f"dds:{DOMAIN}", "second")


@pytest.mark.parametrize("message", [Twist, TwistStamped, Image, CameraInfo, PointCloud2, JointState, TriggerRequest])
def test_cyclone_dds_takes_our_bytes(message: type[Message]) -> None:
    """Its own decoder, from the description of the type, reads what our encoder writes."""
    read = describe(message).deserialize(encode(message()))
    names = [name for name in vars(read) if not name.startswith("_")]
    assert names == (list(message.__dataclass_fields__) or ["structure_needs_at_least_one_member"])  # type: ignore[attr-defined]


def test_services_have_a_header_before_their_fields() -> None:
    names = list(describe_service_part(SetBoolRequest).__dataclass_fields__)
    assert names == ["request_guid", "request_number", "data"]
    assert find_type("std_srvs/srv/SetBool_Request") is SetBoolRequest


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("300", "domain '300'"),
        ("x@127.0.0.1", "domain 'x'"),
        ("0@", "is not an address of DDS"),
        ("0@<x>", "is not an address"),
    ],
)
def test_impossible_address(address: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        open_bus(f"dds:{address}", "robot")


def test_interface_that_is_not_there() -> None:
    with pytest.raises(BusError, match=rf"domain {DOMAIN + 1}"):
        open_bus(f"dds:{DOMAIN + 1}@192.0.2.77", "robot")


def test_absent_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    with pytest.raises(MissingExtra, match=r"(?s)'cyclonedds'.*\[dds\]"):
        open_bus("dds", "robot")
