"""What ``vlatool topics`` finds on a bus."""

from __future__ import annotations

import time

import pytest

from tests._point_robot import Exchange, MemoryBus
from vlatool.buses import QoS, open_bus
from vlatool.errors import BusError, UsageError
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.std_msgs import Header, String
from vlatool.nodes.topic_survey import lines, survey


class Chatty(MemoryBus):
    """A bus of which each look at the topics is followed by messages."""

    senders: tuple = ()

    def topics(self):
        found = super().topics()
        for send, message in self.senders:
            send(message())
        return found


def test_rates_ages_publishers_and_conflicts():
    exchange = Exchange()
    robot, other, rogue = (MemoryBus(exchange, name) for name in ("robot", "teleop", "rogue"))
    bus = Chatty(exchange, "survey")
    stamped = robot.publisher("/odom", Odometry, QoS())
    ahead = robot.publisher("/ahead", Odometry, QoS())
    robot.subscribe("/cmd_vel", Twist, lambda got: None, QoS())
    other.publisher("/cmd_vel", Twist, QoS())
    rogue.publisher("/cmd_vel", Twist, QoS())
    rogue.publisher("/words", String, QoS())
    rogue.publisher("/words", Twist, QoS())
    exchange.publishers["/exotic"] = [("robot", "acme_msgs/msg/Laser")]

    def now(seconds):
        return Odometry(Header(Time.from_seconds(time.time() + seconds)))  # noqa: TID251

    bus.senders = ((stamped, lambda: now(-0.1)), (ahead, lambda: now(3600)))
    found = {report.topic: report for report in survey(bus, "survey", 0.5)}
    assert list(found) == sorted(found)
    assert found["/odom"].publishers == ("robot",)
    assert found["/odom"].messages >= 2
    assert found["/odom"].hz > 1
    assert found["/odom"].age_ms == pytest.approx(100, abs=90)
    assert found["/odom"].problems == ()
    assert found["/cmd_vel"].problems == ("2 publishers command one robot: teleop, rogue",)
    assert found["/cmd_vel"].subscribers == ("robot",)
    assert "2 types on one topic" in found["/words"].problems[0]
    assert found["/exotic"].problems == ("vlatool has no message acme_msgs/msg/Laser: it is listed, not read",)
    assert "s in the future" in found["/ahead"].problems[0]
    text = "\n".join(lines(list(found.values())))
    assert "  ! 2 publishers command one robot" in text
    assert "teleop, rogue -> robot" in text


def test_faults_of_the_bus_are_problems_of_their_topics():
    exchange = Exchange()
    bus = MemoryBus(exchange, "survey")
    MemoryBus(exchange, "robot").publisher("/odom", Odometry, QoS())
    for count in range(3):
        bus.counted.add("/odom", BusError(f"A malformed message came on /odom, number {count}.", "check the robot"))
    (report,) = survey(bus, "survey", 0)
    assert report.problems == ("A malformed message came on /odom, number 2. (3 times); check the robot",)


def test_empty_bus():
    assert list(lines(survey(MemoryBus(Exchange(), "survey"), "survey", 0))) == ["no topic"]


def test_topics_of_a_recording_are_listed_though_nobody_publishes_them(tmp_path):
    written = open_bus(f"bag::{tmp_path / 'run'}", "recorder")
    send = written.publisher("/words", String, QoS())
    for number in range(5):
        send(String(str(number)))
        time.sleep(0.02)
    written.close()
    bus = open_bus(f"bag:{tmp_path / 'run'}", "survey")
    (found,) = survey(bus, "survey", 0.3)
    bus.close()
    assert (found.topic, found.types, found.publishers, found.subscribers) == ("/words", (String.TYPE,), (), ())
    assert found.messages == 5


def test_a_name_that_no_node_can_subscribe_to_is_said_and_makes_no_line_wide():
    exchange = Exchange()
    name = "/" + "n" * 5000
    exchange.publishers[name] = [("rogue", String.TYPE)]
    exchange.publishers["/words"] = [("rogue", String.TYPE)]

    class Strict(MemoryBus):
        def subscribe(self, topic, *arguments):
            if topic == name:
                raise UsageError("It cannot be the name of a topic.", "rename it")
            super().subscribe(topic, *arguments)

    found = {report.topic: report for report in survey(Strict(exchange, "survey"), "survey", 0.0)}
    assert found[name].problems == ("It cannot be the name of a topic.",)
    text = list(lines([*found.values()]))
    assert max(map(len, text)) < 300
