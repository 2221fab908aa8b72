"""A simulated robot as a process on a bus."""

from __future__ import annotations

import threading
import time

import pytest

from tests._point_robot import Exchange, GoTo, MemoryBus, PointWorld, collect
from vlatool.buses import QoS
from vlatool.errors import BusError
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import String
from vlatool.nodes.runner import Runner
from vlatool.nodes.world_node import MAX_COMMANDS, WorldNode
from vlatool.worlds import Channel


@pytest.fixture
def exchange():
    return Exchange()


def test_reports_obeys_and_keeps_pace(exchange):
    other = MemoryBus(exchange, "other")
    seen = collect(other, "/odom", Odometry)
    send = other.publisher("/cmd_vel", Twist, QoS())
    node = WorldNode(PointWorld(noise=0.0), MemoryBus(exchange, "robot"))
    send(Twist(Vector3(1.0)))
    began = time.monotonic()
    summary = node.run(0.3)
    assert time.monotonic() - began >= 0.29
    assert summary.seconds == pytest.approx(0.3)
    assert (summary.reports, summary.commands) == (len(seen), 1)
    assert len(seen) == 16
    assert node.world.truth()["x"] == pytest.approx(0.3, abs=0.01)
    stamps = [message.header.stamp.seconds for message in seen]
    assert stamps[-1] - stamps[0] == pytest.approx(0.3, abs=1e-6)
    assert stamps[-1] == pytest.approx(time.time(), abs=5)  # noqa: TID251


def test_controller_drives_it(exchange):
    world = WorldNode(PointWorld(noise=0.0), MemoryBus(exchange, "robot"))
    runner = Runner(GoTo(goal_x=0.05, goal_y=0.0, rate_hz=50), MemoryBus(exchange, "vlatool_go_to"))
    thread = threading.Thread(target=world.run)
    thread.start()
    runner.run(0.8)
    world.stop()
    thread.join()
    assert runner.summary.status == "there"
    assert world.world.truth()["x"] == pytest.approx(0.05, abs=0.05)


def test_newest_commands_are_kept(exchange):
    send = MemoryBus(exchange, "other").publisher("/cmd_vel", Twist, QoS())
    node = WorldNode(PointWorld(noise=0.0), MemoryBus(exchange, "robot"))
    for number in range(MAX_COMMANDS + 50):
        send(Twist(Vector3(float(number))))
    node.run(0.02)
    assert node.summary.commands == MAX_COMMANDS
    assert node.world._velocity[0] == MAX_COMMANDS + 49


def test_slow_processor_is_counted(exchange):
    node = WorldNode(PointWorld(), MemoryBus(exchange, "robot"))
    slow = iter([0.4])
    node.run(0.05, observer=lambda world: time.sleep(next(slow, 0.0)))
    assert node.summary.behind_s > 0.25


def test_sensors_are_offered_reliably_for_subscribers_that_ask_for_it_and_pictures_are_not(exchange):
    offered = {}

    class Seeing(PointWorld):
        sensors = (*PointWorld().sensors, Channel("/image", Image, 10.0), Channel("/plan", String))

    class Noting(MemoryBus):
        def publisher(self, topic, message, qos):
            offered[topic] = qos
            return super().publisher(topic, message, qos)

    WorldNode(Seeing(), Noting(exchange, "robot"))
    assert {topic: (qos.reliable, qos.latched) for topic, qos in offered.items()} == {
        "/odom": (True, False), "/image": (False, False), "/plan": (True, True)
    }  # fmt: skip


def test_bus_that_fails_ends_it(exchange):
    bus = MemoryBus(exchange, "robot")
    node = WorldNode(PointWorld(), bus)
    bus.close()
    with pytest.raises(BusError):
        node.run(1)


def test_message_without_header_is_passed_on():
    from vlatool.nodes.world_node import restamp

    message = String("a")
    assert restamp(message, 5.0) is message
