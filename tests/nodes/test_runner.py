"""A controller on a bus: its schedule, its services, and how it ends."""

from __future__ import annotations

import threading
import time

import pytest
from _point_robot import GoTo, MemoryBus

from vlatool.buses import QoS
from vlatool.errors import BusError, UsageError
from vlatool.messages import same
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.std_msgs import Bool, String
from vlatool.nodes.runner import Runner, RunSummary
from vlatool.nodes.topics import map_topics


def runner(controller: GoTo, bus: MemoryBus) -> Runner:
    return Runner(controller, bus, map_topics(controller, {}))


def test_it_steps_at_its_rate_and_ends_at_rest() -> None:
    bus, controller = MemoryBus(), GoTo(rate_hz=100.0)
    run = runner(controller, bus)
    bus.publisher("/odom", Odometry, QoS())(Odometry())
    summary = run.run(0.3)
    assert summary.steps + summary.missed == 30
    assert summary.messages == {"odometry": 1, "note": 0}
    assert summary.statuses["driving"] == summary.steps
    *driven, last = bus.sent["/cmd_vel"]
    assert len(driven) == summary.steps
    assert same(last, Twist())


def test_steps_that_no_time_is_left_for_are_missed_not_caught_up() -> None:
    bus = MemoryBus()
    summary = runner(GoTo(rate_hz=100.0, slow_s=0.025), bus).run(0.3)
    assert summary.steps + summary.missed >= 30
    assert summary.missed >= summary.steps, "each step takes the time of two and a half"


def test_a_step_that_raises_leaves_the_robot_at_rest() -> None:
    bus = MemoryBus()
    bus.publisher("/odom", Odometry, QoS())
    run = runner(GoTo(fail_at=2), bus)
    bus.publisher("/odom", Odometry, QoS())(Odometry())
    with pytest.raises(ValueError, match="planted"):
        run.run(5)
    assert same(bus.sent["/cmd_vel"][-1], Twist())


def test_a_service_is_answered_by_the_next_step() -> None:
    bus = MemoryBus()
    run = runner(GoTo(), bus)
    ended: list[RunSummary] = []
    thread = threading.Thread(target=lambda: ended.append(run.run()))
    thread.start()
    answer = bus.call("/hold", Bool(), String, 1.0)
    run.stop()
    thread.join(10)
    assert not thread.is_alive()
    assert answer.data.startswith("step ")
    assert ended[0].steps >= 1


def test_a_call_that_no_step_answers_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlatool.nodes.runner.ANSWER_S", 0.01)
    bus = MemoryBus()
    runner(GoTo(), bus)
    with pytest.raises(BusError, match="hold was not answered in 0.01 s"):
        bus.call("/hold", Bool(), String, 1.0)


def test_ending_takes_no_whole_period() -> None:
    bus = MemoryBus()
    run = runner(GoTo(rate_hz=0.01), bus)
    thread = threading.Thread(target=run.run)
    thread.start()
    time.sleep(0.05)
    run.stop()
    thread.join(20)
    assert not thread.is_alive()


def test_another_type_under_the_topic_is_refused() -> None:
    bus = MemoryBus()
    bus.publisher("/odom", Twist, QoS())
    with pytest.raises(BusError, match="/odom carries geometry_msgs/msg/Twist"):
        runner(GoTo(), bus)


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        ({"odometri": "/odom"}, "odometry"),
        ({"odometry": "/wheel odom"}, "/wheel_odom"),
        ({"odometry": ""}, "cannot be the name"),
        ({"odometry": "/a//b"}, "cannot be the name"),
    ],
)
def test_an_impossible_map_is_refused(wanted: dict[str, str], says: str) -> None:
    with pytest.raises(UsageError) as caught:
        map_topics(GoTo(), wanted)
    assert says in str(caught.value)


def test_a_topic_without_a_slash_is_of_the_root() -> None:
    assert map_topics(GoTo(), {"odometry": "wheel/odom"})["odometry"] == "/wheel/odom"
