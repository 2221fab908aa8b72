"""The run of a controller on a bus: schedule, rest at every end, services, conflicts, counts."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from tests._point_robot import Exchange, Failing, GoTo, MemoryBus, collect
from vlatool.buses import QoS
from vlatool.controllers import Command, Service
from vlatool.errors import BusError, DataError, UsageError
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.std_msgs import Bool, String
from vlatool.nodes.runner import Runner


@pytest.fixture
def exchange():
    return Exchange()


@pytest.fixture
def others(exchange):
    return MemoryBus(exchange, "others")


def runner_of(exchange, controller, **options) -> Runner:
    return Runner(controller, MemoryBus(exchange, "vlatool_test"), **options)


def test_steps_at_its_rate_and_rests(exchange, others):
    sent = collect(others, "/cmd_vel", Twist)
    others.publisher("/odom", Odometry, QoS())(Odometry())
    seen = []
    runner = runner_of(exchange, GoTo(rate_hz=100), observers=[seen.append])
    summary = runner.run(0.2)
    assert summary.steps + summary.skipped == 20
    assert [report.number for report in seen] == list(range(summary.steps))
    assert len(sent) == summary.steps + 1
    assert sent[-1].linear.x == 0
    assert summary.status == "waiting for /odom"  # the message came before the controller


def test_schedule_does_not_drift_and_late_steps_are_left_out(exchange):
    seen = []

    def slow(report):
        seen.append(report)
        if report.number == 2:
            time.sleep(0.055)

    runner_of(exchange, GoTo(rate_hz=100), observers=[slow]).run(0.2)
    began = seen[0].snapshot.time_s - seen[0].late_s
    ticks = [(report.snapshot.time_s - report.late_s - began) * 100 for report in seen]
    assert ticks == pytest.approx([round(tick) for tick in ticks], abs=1e-6)
    assert seen[3].skipped >= 5
    assert round(ticks[-1]) == sum(1 + report.skipped for report in seen) - 1


def test_newest_messages_are_kept(exchange, others):
    send = others.publisher("/instruction", String, QoS())
    seen = []
    runner = runner_of(exchange, GoTo(rate_hz=50), observers=[seen.append])
    for number in range(5):
        send(String(str(number)))
    summary = runner.run(0.05)
    readings = seen[0].snapshot.readings["instruction"]
    assert [(reading.message.data, reading.sequence) for reading in readings] == [("2", 2), ("3", 3), ("4", 4)]
    assert seen[1].snapshot.readings["instruction"] == ()
    assert seen[1].snapshot.newest["instruction"].message.data == "4"
    assert summary.overwritten == {"odom": 0, "instruction": 2}


@pytest.mark.parametrize("error", [RuntimeError("a fault"), DataError("bad data"), KeyboardInterrupt()])
def test_step_that_raises_ends_in_rest(exchange, others, error):
    sent = collect(others, "/cmd_vel", Twist)
    with pytest.raises(type(error)):
        runner_of(exchange, Failing(at=2, error=error)).run(5)
    assert [message.linear.x for message in sent] == [1, 1, 0]


@pytest.fixture
def unhandled_signals():
    handlers = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("number", "raised"),
    [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit), (signal.SIGHUP, SystemExit)],
)
def test_signals_end_in_rest(exchange, others, number, raised, unhandled_signals):
    sent = collect(others, "/cmd_vel", Twist)
    waiting = [number]
    others.subscribe("/cmd_vel", Twist, lambda _: waiting and os.kill(os.getpid(), waiting.pop()), QoS())
    with pytest.raises(raised) as left:
        runner_of(exchange, Failing(at=-1)).run(10)
    assert getattr(left.value, "code", 128 + number) == 128 + number
    assert sent[-1].linear.x == 0
    assert all(message.linear.x == 1 for message in sent[:-1])
    assert [signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)] == [signal.SIG_DFL] * 2


def test_stop_from_another_thread(exchange, others):
    sent = collect(others, "/cmd_vel", Twist)
    runner = runner_of(exchange, Failing(at=-1))
    threading.Timer(0.03, runner.stop).start()
    runner.run()
    assert sent[-1].linear.x == 0


def test_rest_reaches_what_still_takes_it(exchange, others):
    class Two(GoTo):
        def rest(self):
            return Command({"cmd": (Twist(),), "status": (String("at rest"),)})

    words = collect(others, "/status", String)
    runner = runner_of(exchange, Two())

    def gone(message):
        raise BusError("The bus is gone.")

    runner._senders["cmd"] = gone
    with pytest.raises(BusError, match="gone"):
        runner.run(1)
    assert [word.data for word in words] == ["at rest"]


def test_services_are_answered_by_a_step(exchange, others):
    runner = runner_of(exchange, GoTo(rate_hz=100))
    thread = threading.Thread(target=runner.run, args=(5,))
    thread.start()
    assert others.call("/halt", Bool(True), Bool, 1).data
    runner.stop()
    thread.join()
    assert runner.summary.status == "halted"
    with pytest.raises(BusError, match="the controller has ended"):
        others.call("/halt", Bool(True), Bool, 1)


def test_call_that_no_step_answers(exchange):
    runner = runner_of(exchange, GoTo())
    with pytest.raises(BusError, match=r"no step answered within 0\.01 s"):
        runner._stepper.calls.ask("halt", Bool(True), 0.01)
    assert runner._stepper.calls.take() == ()


def test_a_call_waits_as_long_as_its_service_says(exchange, others):
    class Impatient(GoTo):
        services = (Service("halt", "/halt", Bool, Bool, answer_s=0.01),)

    runner_of(exchange, Impatient())
    with pytest.raises(BusError, match=r"no step answered within 0\.01 s"):
        others.call("/halt", Bool(True), Bool, 1)


def test_too_many_calls_are_refused(exchange):
    calls = runner_of(exchange, GoTo())._stepper.calls
    for _ in range(64):
        calls.add("halt", Bool(True))
    with pytest.raises(BusError, match="64 calls already wait"):
        calls.add("halt", Bool(True))


def test_another_publisher_is_refused(exchange, others):
    others.publisher("/cmd_vel", Twist, QoS())
    with pytest.raises(BusError, match="/cmd_vel has the publisher others already"):
        runner_of(exchange, GoTo())
    runner_of(exchange, GoTo(), topics={"cmd": "/other/cmd_vel"})
    runner_of(exchange, GoTo(), alone=False)


def test_another_publisher_that_is_seen_late_is_refused_before_the_first_step(exchange, others):
    """Networks list other nodes after a while: a controller that starts beside another one must not miss it."""
    sent = collect(others, "/cmd_vel", Twist)
    runner = runner_of(exchange, GoTo(rate_hz=100))
    others.publisher("/cmd_vel", Twist, QoS())
    with pytest.raises(BusError, match=r"/cmd_vel has the publishers others, vlatool_test: two would command one"):
        runner.run(0.1)
    assert not sent
    assert runner.summary.steps == 0
    runner_of(exchange, GoTo(rate_hz=100), alone=False).run(0.02)
    assert sent


def test_another_type_is_refused(exchange, others):
    others.publisher("/odom", Twist, QoS())
    with pytest.raises(BusError, match=r"/odom carries geometry_msgs/msg/Twist; the controller's 'odom' is nav_msgs"):
        runner_of(exchange, GoTo())


def test_topics_are_mapped_by_name_or_topic(exchange):
    runner = runner_of(exchange, GoTo(), topics={"odom": "/a/odom", "/halt": "/b/halt"})
    assert runner.topics == {"odom": "/a/odom", "instruction": "/instruction", "cmd": "/cmd_vel", "status": "/status",
                             "halt": "/b/halt"}  # fmt: skip
    assert runner.missing(0) == ("/a/odom",)


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        ({"odo": "/odom"}, "no topic 'odo' to map; did you mean 'odom'"),
        ({"odom": "odom"}, "'odom' is mapped to 'odom', which is not the name of a topic"),
        ({"odom": "/a b"}, "not the name of a topic"),
        ({"status": "/cmd_vel"}, "Two outputs of the controller are mapped to /cmd_vel"),
    ],
)
def test_impossible_maps(exchange, topics, words):
    with pytest.raises(UsageError, match=words):
        runner_of(exchange, GoTo(), topics=topics)


@pytest.mark.parametrize("rate", [0, -1, float("nan"), float("inf"), "10", True])
def test_impossible_rates(exchange, rate):
    with pytest.raises(UsageError, match="rate"):
        runner_of(exchange, GoTo(rate_hz=rate))


@pytest.mark.parametrize(
    ("sends", "words"),
    [
        ({"arm": (Twist(),)}, "sends on the output 'arm', which it does not have"),
        ({"cmd": (Vector3(),)}, "sends geometry_msgs/msg/Vector3 on 'cmd', which carries geometry_msgs/msg/Twist"),
    ],
)
def test_wrong_commands(exchange, others, sends, words):
    sent = collect(others, "/cmd_vel", Twist)
    with pytest.raises(BusError, match=words):
        runner_of(exchange, Failing(sends=sends)).run(1)
    assert [message.linear.x for message in sent] == [0]
