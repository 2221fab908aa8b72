from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from vlatool.buses import (
    GOAL_ABORTED,
    GOAL_CANCELED,
    GOAL_SUCCEEDED,
    ActionBus,
    ActionType,
    Bus,
    Goal,
    Outcome,
    QoS,
    Reception,
    TopicInfo,
    open_bus,
)
from vlatool.buses.sim import Sim
from vlatool.errors import BusError, UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.std_msgs import Bool, String

KIND = ActionType("std_msgs/action/Say", String, String, Bool)
WAIT_S = 10.0
Nodes = Callable[[str], Sim]


@pytest.fixture
def node(request: pytest.FixtureRequest) -> Iterator[Nodes]:
    opened: list[Sim] = []

    def open_node(name: str) -> Sim:
        opened.append(Sim(request.node.nodeid, name))
        return opened[-1]

    yield open_node
    for bus in opened:
        bus.close()


@pytest.fixture
def traceback(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What threads raised."""
    found: list[str] = []
    monkeypatch.setattr(threading, "excepthook", lambda raised: found.append(str(raised.exc_value)))
    return found


def numbered(number: float) -> Twist:
    return Twist(Vector3(number))


def test_it_is_a_bus_with_actions_and_an_address_is_no_other_one() -> None:
    one, other = open_bus("sim:one", "a"), open_bus("sim:other", "a")
    assert isinstance(one, Bus)
    assert isinstance(one, ActionBus)
    one.publisher("/cmd_vel", Twist, QoS())
    assert [info.topic for info in one.topics()] == ["/cmd_vel"]
    assert other.topics() == []
    one.close()
    other.close()
    one.close()


def test_messages_arrive_in_order_as_the_objects_that_were_sent(node: Nodes) -> None:
    robot, controller = node("robot"), node("controller")
    got: list[Reception] = []
    controller.subscribe("/cmd_vel", Twist, got.append, QoS(depth=100))
    send = robot.publisher("cmd_vel", Twist, QoS())
    sent = [numbered(number) for number in range(100)]
    for message in sent:
        send(message)
    assert robot.settle(WAIT_S)
    assert all(one.message is other for one, other in zip(got, sent, strict=True))
    assert np.diff([each.received_s for each in got]).min() >= 0


def test_only_the_newest_messages_wait_for_a_handler_that_is_busy(node: Nodes) -> None:
    robot, controller = node("robot"), node("controller")
    got: list[float] = []
    entered, go_on = threading.Event(), threading.Event()

    def handle(reception: Reception) -> None:
        entered.set()
        assert go_on.wait(WAIT_S)
        assert isinstance(reception.message, Twist)
        got.append(reception.message.linear.x)

    controller.subscribe("/cmd_vel", Twist, handle, QoS(depth=2))
    send = robot.publisher("/cmd_vel", Twist, QoS())
    send(numbered(0))
    assert entered.wait(WAIT_S)
    for number in range(1, 10):
        send(numbered(number))
    go_on.set()
    assert robot.settle(WAIT_S)
    assert got == [0, 8, 9]


def test_a_latched_message_reaches_who_comes_later_while_its_node_is_there(node: Nodes) -> None:
    robot, early, late = node("robot"), node("early"), node("late")
    robot.publisher("/map", String, QoS(latched=True))(String("walls"))
    got: list[str] = []
    early.subscribe("/map", String, lambda each: got.append("volatile"), QoS())
    early.subscribe("/map", String, lambda each: got.append("latched"), QoS(latched=True))
    assert robot.settle(WAIT_S)
    robot.close()
    late.subscribe("/map", String, lambda each: got.append("late"), QoS(latched=True))
    assert late.settle(WAIT_S)
    assert got == ["latched"]


def test_topics_name_both_publishers_of_a_command(node: Nodes) -> None:
    one, two, robot = node("one"), node("two"), node("robot")
    for bus in (one, two):
        bus.publisher("/cmd_vel", Twist, QoS())
    robot.subscribe("/cmd_vel", Twist, lambda each: None, QoS())
    robot.publisher("~state", String, QoS())
    expected = TopicInfo("/cmd_vel", ("geometry_msgs/msg/Twist",), ("one", "two"), ("robot",))
    assert robot.topics() == [expected, TopicInfo("/robot/state", ("std_msgs/msg/String",), ("robot",))]


def test_another_type_is_refused_with_both_names(node: Nodes) -> None:
    one, two = node("one"), node("two")
    send = one.publisher("/cmd_vel", Twist, QoS())
    for attempt in (
        lambda: two.subscribe("/cmd_vel", String, lambda each: None, QoS()),
        lambda: two.publisher("cmd_vel", String, QoS()),
    ):
        with pytest.raises(BusError, match=r"/cmd_vel carries geometry_msgs/msg/Twist, not std_msgs/msg/String"):
            attempt()
    with pytest.raises(BusError, match="not a String"):
        send(String())  # type: ignore[arg-type]
    one.close()
    two.publisher("/cmd_vel", String, QoS())
    with pytest.raises(BusError, match="left the bus"):
        send(numbered(1))


@pytest.mark.parametrize("name", ["", "/", "cmd vel", "/1st", "/a//b", "/a/", "/a/2", "wörter", "/a-b", "~", "$x"])
def test_an_impossible_name_is_refused(node: Nodes, name: str) -> None:
    with pytest.raises(UsageError, match=r"cannot be the name of a topic or service; (?s:.*)write '/"):
        node("robot").publisher(name, Twist, QoS())


@pytest.mark.parametrize("name", ["", "/node", "my-node", "1st", "a b"])
def test_an_impossible_node_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be the name of a node"):
        Sim("", name)


def test_a_handler_that_raises_is_counted_and_called_again(node: Nodes) -> None:
    robot, controller = node("robot"), node("controller")
    got: list[float] = []

    def handle(reception: Reception) -> None:
        assert isinstance(reception.message, Twist)
        if reception.message.linear.x == 0:
            raise ValueError("no speed")
        got.append(reception.message.linear.x)

    controller.subscribe("/cmd_vel", Twist, handle, QoS(depth=2))
    send = robot.publisher("/cmd_vel", Twist, QoS())
    send(numbered(0))
    send(numbered(2))
    assert robot.settle(WAIT_S)
    assert got == [2]
    (fault,) = controller.faults()
    assert (fault.topic, fault.count) == ("/cmd_vel", 1)
    assert "The handler of /cmd_vel raised ValueError: no speed." in fault.error.message


def test_a_service_answers_fails_is_late_or_is_absent(node: Nodes) -> None:
    robot, monitor = node("robot"), node("monitor")
    never = threading.Event()

    def answer(request: Message) -> Bool:
        assert isinstance(request, String)
        if request.data == "late":
            never.wait(WAIT_S)
        return Bool({"yes": True, "no": False, "late": False}[request.data])

    monitor.serve("/ask", String, Bool, answer)
    assert [robot.call("ask", String(word), Bool, WAIT_S).data for word in ("yes", "no")] == [True, False]
    with pytest.raises(BusError, match="/ask failed: 'what'"):
        robot.call("/ask", String("what"), Bool, WAIT_S)
    with pytest.raises(BusError, match=r"no answer within 0.02 s"):
        robot.call("/ask", String("late"), Bool, 0.02)
    never.set()
    with pytest.raises(BusError, match=r"Nobody has served /nothing within 0.01 s"):
        robot.call("/nothing", String(), Bool, 0.01)
    with pytest.raises(BusError, match="takes std_msgs/msg/String, not std_msgs/msg/Bool"):
        robot.call("/ask", Bool(), Bool, WAIT_S)
    with pytest.raises(BusError, match="served already, by monitor"):
        robot.serve("/ask", String, Bool, answer)
    monitor.close()
    with pytest.raises(BusError, match="Nobody"):
        robot.call("/ask", String("yes"), Bool, 0.01)


def test_peers_are_waited_for(node: Nodes) -> None:
    robot, controller = node("robot"), node("controller")
    controller.subscribe("/scan", String, lambda each: None, QoS())
    controller.publisher("/cmd_vel", Twist, QoS())
    assert controller.wait_for_peers(("/scan", "/cmd_vel"), 0.01) == ("/scan", "/cmd_vel")

    def come() -> None:
        robot.publisher("/scan", String, QoS())
        robot.subscribe("/cmd_vel", Twist, lambda each: None, QoS())

    timer = threading.Timer(0.01, come)
    timer.start()
    assert controller.wait_for_peers(("/scan", "cmd_vel"), WAIT_S) == ()
    timer.join()


def test_the_simulated_clock_stamps_messages_and_never_goes_back(node: Nodes) -> None:
    robot, controller = node("robot"), node("controller")
    assert robot.stamp().sec > 1_700_000_000
    got: list[float] = []
    controller.subscribe("/cmd_vel", Twist, lambda each: got.append(each.received_s), QoS(depth=9))
    send = robot.publisher("/cmd_vel", Twist, QoS())
    for moment in (0.0, 0.1, 7.25):
        robot.set_time(moment)
        send(numbered(moment))
    assert controller.settle(WAIT_S)
    assert got == [0.0, 0.1, 7.25]
    assert controller.stamp().seconds == Time(7, 250_000_000).seconds
    with pytest.raises(BusError, match=r"shows 7.25 s and cannot go back to 7 s"):
        controller.set_time(7.0)


def test_an_action_reports_and_ends(node: Nodes) -> None:
    robot, client = node("robot"), node("client")

    def run(goal: Goal) -> Outcome:
        assert isinstance(goal.message, String)
        for word in goal.message.data.split():
            goal.feedback(String(word))
        return Outcome(GOAL_SUCCEEDED, Bool(True))

    robot.serve_action("/say", KIND, run)
    said: list[Message] = []
    outcome = client.send_goal("/say", KIND, String("go to the ball"), said.append).result(WAIT_S)
    assert outcome.status == GOAL_SUCCEEDED
    assert isinstance(outcome.result, Bool)
    assert outcome.result.data
    assert [each.data for each in said if isinstance(each, String)] == ["go", "to", "the", "ball"]
    with pytest.raises(BusError, match="Nobody serves the action /sing"):
        client.send_goal("/sing", KIND, String())
    with pytest.raises(BusError, match="is a std_msgs/action/Say, not a x"):
        client.send_goal("/say", KIND._replace(name="x"), String())
    with pytest.raises(BusError, match="served already"):
        client.serve_action("/say", KIND, run)


def test_a_goal_is_canceled_by_its_client_by_a_newer_one_and_by_the_end(node: Nodes, traceback: list[str]) -> None:
    robot, client = node("robot"), node("client")
    started: list[str] = []
    began = threading.Semaphore(0)

    def run(goal: Goal) -> Outcome:
        assert isinstance(goal.message, String)
        started.append(goal.message.data)
        began.release()
        if goal.message.data == "fail":
            raise ValueError("no such place")
        assert goal.canceled.wait(WAIT_S)
        return Outcome(GOAL_CANCELED, Bool())

    robot.serve_action("~say", KIND, run)
    first = client.send_goal("/robot/say", KIND, String("first"))
    assert began.acquire(timeout=WAIT_S)
    with pytest.raises(BusError, match=r"no result within 0\.01 s"):
        first.result(0.01)
    first.cancel()
    assert first.result(WAIT_S).status == GOAL_CANCELED
    second, third = (client.send_goal("/robot/say", KIND, String(word)) for word in ("second", "third"))
    assert second.result(WAIT_S).status == GOAL_CANCELED
    failing = client.send_goal("/robot/say", KIND, String("fail"))
    assert [third.result(WAIT_S).status, failing.result(WAIT_S).status] == [GOAL_CANCELED, GOAL_ABORTED]
    last = client.send_goal("/robot/say", KIND, String("last"))
    while "last" not in started:
        assert began.acquire(timeout=WAIT_S)
    robot.close()
    assert last.result(WAIT_S).status == GOAL_CANCELED
    assert traceback == ["no such place"]


def test_nodes_that_come_and_go_in_several_threads_block_nobody(request: pytest.FixtureRequest) -> None:
    address, failures = request.node.nodeid, []

    def live(seed: int) -> None:
        draw = np.random.default_rng(seed)
        try:
            for step in range(40):
                bus = Sim(address, f"node_{seed}_{step}")
                bus.subscribe("/cmd_vel", Twist, lambda each: None, QoS(depth=2))
                bus.serve(f"/ask_{seed}", String, Bool, lambda each: Bool(True))
                send = bus.publisher("/cmd_vel", Twist, QoS(latched=True))
                for number in range(int(draw.integers(5))):
                    send(numbered(number))
                assert bus.call(f"/ask_{seed}", String(), Bool, WAIT_S).data
                assert bus.topics()[0].topic == "/cmd_vel"
                bus.close()
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=live, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert not any(thread.is_alive() for thread in threads)
    assert not failures
    last = Sim(address, "last")
    assert last.topics() == []
    last.close()
