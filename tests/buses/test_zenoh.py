"""Nodes on a Zenoh bus: what every bus does, and what rmw_zenoh's wire asks for."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
from buses._nodes import NetworkBus, Open, opened
from buses._trials import QUALITY, WAIT_S, Heard, forward, free_port, wait_until

from vlatool.buses import Bus, open_bus
from vlatool.buses._graph import SUBSCRIBER, Entity
from vlatool.buses._zenoh_keys import ATTACHMENT, data_key, entity_token
from vlatool.errors import BusError, MissingExtra, UsageError
from vlatool.messages.cdr import encode
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse, TriggerRequest, TriggerResponse
from vlatool.messages.type_hash import rihs01

zenoh = pytest.importorskip("zenoh")


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def open_node(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Open:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.delenv("ZENOH_SESSION_CONFIG_URI", raising=False)
    prefixes = iter(["router/"])

    def open_one(name: str) -> Bus:
        return open_bus(f"zenoh:{next(prefixes, '')}{endpoint}", name)

    return open_one


class TestZenoh(NetworkBus):
    """What every network bus does."""

    def test_malformed_bytes_are_counted_and_the_next_message_comes(self, open_node: Open) -> None:
        with opened(open_node, "robot", "other") as (robot, other):
            heard = Heard(robot, "/cmd_vel")
            key = data_key(0, "/cmd_vel", Twist.TYPE, rihs01(Twist))
            for data in (b"", b"\0\1\0\0", encode(forward(1.0))[:-1], b"\xff" * 52, encode(forward(1.0)) + bytes(8)):
                other._session.put(key, data)  # type: ignore[attr-defined]
            other._session.put(key, encode(forward(3.0)))  # type: ignore[attr-defined]
            assert heard.has(1)
            assert heard.messages[0].linear.x == 3.0
            (fault,) = robot.faults()
            assert (fault.topic, fault.count) == ("/cmd_vel", 5)
            assert "malformed" in str(fault.error)

    def test_attachment_and_tokens_are_those_of_rmw_zenoh(self, open_node: Open) -> None:
        with opened(open_node, "robot", "other") as (robot, other):
            samples: list[object] = []
            session = other._session  # type: ignore[attr-defined]
            session.declare_subscriber(data_key(0, "/cmd_vel", Twist.TYPE, rihs01(Twist)), samples.append)
            send = robot.publisher("/cmd_vel", Twist, QUALITY)
            assert wait_until(lambda: (send(forward(1.0)), wait_until(lambda: len(samples) >= 2, 0.1))[1])
            numbers, gids = [], set()
            for sample in samples:
                attached = sample.attachment.to_bytes()  # type: ignore[attr-defined]
                assert len(attached) == 33
                number, _, length, gid = ATTACHMENT.unpack(attached)
                numbers.append(number)
                gids.add((length, gid))
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
            assert len(gids) == 1
            tokens: list[str] = []

            def robot_is_listed() -> bool:
                replies = session.liveliness().get("@ros2_lv/0/**", timeout=WAIT_S)
                tokens[:] = [str(reply.ok.key_expr) for reply in replies]
                return any("/robot/%cmd_vel/" in token for token in tokens)

            assert wait_until(robot_is_listed)
            own = str(robot._session.info.zid())  # type: ignore[attr-defined]
            assert f"@ros2_lv/0/{own}/0/0/NN/%/%/robot" in tokens
            name = f"MP/%/%/robot/%cmd_vel/geometry_msgs::msg::dds_::Twist_/{rihs01(Twist)}/1:2:1,10:,:,:,,"
            assert any(token.endswith(name) for token in tokens)

    def test_peer_without_a_way_to_it_is_none_yet(self, open_node: Open) -> None:
        with opened(open_node, "robot", "other") as (robot, other):
            entity = Entity("1" * 30, SUBSCRIBER, "late", "/cmd_vel", Twist.TYPE, rihs01(Twist))
            token = other._session.liveliness().declare_token(  # type: ignore[attr-defined]
                entity_token(0, 1, entity, QUALITY)
            )
            robot.publisher("/cmd_vel", Twist, QUALITY)
            assert wait_until(lambda: any("late" in info.subscribers for info in robot.topics()))
            assert robot.wait_for_peers(("/cmd_vel",), 0.1) == ("/cmd_vel",)
            Heard(other, "/cmd_vel")
            assert robot.wait_for_peers(("/cmd_vel",), WAIT_S) == ()
            token.undeclare()

    def test_a_new_node_knows_the_others_at_once(self, open_node: Open) -> None:
        """It meets them beside the router, after it is there: nobody may take a topic for free meanwhile."""
        with opened(open_node, "router", "robot") as (_, robot):
            robot.publisher("/cmd_vel", Twist, QUALITY)
            for number in range(6):
                with opened(open_node, f"later{number}") as (later,):
                    known = {info.topic: info.publishers for info in later.topics()}
                    assert known.get("/cmd_vel") == ("robot",)

    def test_foreign_type_that_appears_later_is_a_fault(self, open_node: Open) -> None:
        with opened(open_node, "robot", "other") as (robot, other):
            Heard(robot, "/cmd_vel")
            key = "@ros2_lv/0/abc/0/9/MP/%/%/wrong/%cmd_vel/std_msgs::msg::dds_::String_/RIHS01_0/1:2:1,10:,:,:,,"
            token = other._session.liveliness().declare_token(key)  # type: ignore[attr-defined]
            assert wait_until(lambda: bool(robot.faults()))
            assert "carries std_msgs/msg/String (node wrong), not geometry_msgs/msg/Twist" in str(
                robot.faults()[0].error
            )
            token.undeclare()

    def test_service_of_another_type_is_named(self, open_node: Open) -> None:
        with opened(open_node, "robot", "caller") as (robot, caller):
            robot.serve("/stop", SetBoolRequest, SetBoolResponse, lambda _: SetBoolResponse())
            with pytest.raises(BusError, match=r"/stop is a std_srvs/srv/SetBool .*, not a std_srvs/srv/Trigger"):
                caller.call("/stop", TriggerRequest(), TriggerResponse, WAIT_S)

    def test_domains_do_not_mix(self, open_node: Open, monkeypatch: pytest.MonkeyPatch) -> None:
        with opened(open_node, "robot") as (robot,):
            Heard(robot, "/cmd_vel")
            monkeypatch.setenv("ROS_DOMAIN_ID", "7")
            with opened(open_node, "elsewhere") as (elsewhere,):
                assert elsewhere.topics() == []


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:7447", "is not an endpoint of Zenoh"),
        ("tcp/", "is not an endpoint"),
        ("router/x", "is not an endpoint"),
    ],
)
def test_impossible_address(address: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        open_bus(f"zenoh:{address}", "robot")


def test_no_router_answers(endpoint: str) -> None:
    with pytest.raises(
        BusError, match=r"No router of Zenoh answers at tcp/127\.0\.0\.1:\d+ within 3 s.*\n.*rmw_zenohd"
    ):
        open_bus(f"zenoh:{endpoint}", "robot")


def test_two_routers_on_one_port(open_node: Callable[[str], Bus], endpoint: str) -> None:
    with opened(open_node, "robot"), pytest.raises(BusError, match="cannot be Zenoh's router at"):
        open_bus(f"zenoh:router/{endpoint}", "second")


def test_absent_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(MissingExtra, match=r"(?s)'zenoh'.*\[zenoh\]"):
        open_bus("zenoh", "robot")


def test_wrong_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "300")
    with pytest.raises(UsageError, match="'300' of the environment variable ROS_DOMAIN_ID is not a whole number"):
        open_bus("zenoh", "robot")


def test_unreadable_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", "/does/not/exist.json5")
    with pytest.raises(UsageError, match=r"ZENOH_SESSION_CONFIG_URI names '/does/not/exist.json5'"):
        open_bus("zenoh", "robot")
