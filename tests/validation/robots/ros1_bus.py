"""The bus ``ros1`` against the real rospy of Debian's packages: messages bit for bit, times, services, kills.

    python tests/validation/robots/ros1_bus.py -o out/ros1

Unpacks ROS 1 into the folder (2 MB from Debian, 30 MB from PyPI), starts masters on free ports, prints a table, and
exits with 1 when a line of it failed.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from _ros1 import Master, Peer, Rows, prepare, refused
from _ros1_ends import ends, kill_of_the_master, without_a_master

from vlatool.buses import GOAL_CANCELED, GOAL_SUCCEEDED, ActionType, Goal, Outcome, QoS, Reception, open_bus
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.ros1 import encode
from vlatool.messages.schema import int32
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import String
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse

HERE = Path(__file__).resolve().parent
TWISTS, IMAGES = 1000, 300


@dataclass(frozen=True, eq=False)
class TestGoal(Message, name="actionlib/action/Test_Goal"):
    """The goal of actionlib's own tests."""

    goal: int32 = 0


@dataclass(frozen=True, eq=False)
class TestFeedback(Message, name="actionlib/action/Test_Feedback"):
    """The feedback of actionlib's own tests."""

    feedback: int32 = 0


@dataclass(frozen=True, eq=False)
class TestResult(Message, name="actionlib/action/Test_Result"):
    """The result of actionlib's own tests."""

    result: int32 = 0


TEST = ActionType("actionlib/action/Test", TestGoal, TestFeedback, TestResult)


def twists(number: int) -> list[Twist]:
    """Return messages of random bits: subnormal numbers, infinities, NaN and minus zero are among them."""
    values = np.random.default_rng(7).integers(0, 1 << 64, (number, 6), np.uint64).view(np.float64)
    values[:4] = np.array([[-0.0], [np.inf], [np.nan], [5e-324]])
    return [Twist(Vector3(*row[:3]), Vector3(*row[3:])) for row in values.tolist()]


def both_directions(bus: Any, rows: Rows) -> None:
    """Send Twists to a peer that sends them back; compare what it got by what comes back."""
    got: list[bytes] = []
    bus.subscribe("/back", Twist, lambda each: got.append(encode(each.message)), QoS(depth=2 * TWISTS))
    send = bus.publisher("/there", Twist, QoS(depth=2 * TWISTS))
    rows.append(("peers found", "", bus.wait_for_peers(("/back", "/there"), 5.0) == ()))
    time.sleep(0.3)
    sent = twists(TWISTS)
    for message in sent:
        send(message)
    until = time.monotonic() + 10
    while len(got) < TWISTS and time.monotonic() < until:
        time.sleep(0.01)
    equal = sum(one == encode(other) for one, other in zip(got, sent, strict=False))
    rows.append((f"Twists there and back, bit-equal, of {TWISTS}", str(equal), equal == len(got) == TWISTS))


def one_direction(bus: Any, rows: Rows) -> None:
    """Send Twists to a peer that prints their bytes as rospy's own class writes them."""
    send = bus.publisher("/printed", Twist, QoS(depth=2 * TWISTS))
    with Peer("subscribe", "/printed") as peer:
        peer.read()
        bus.wait_for_peers(("/printed",), 5.0)
        sent = twists(TWISTS)
        for message in sent:
            send(message)
        equal = sum(peer.read() == encode(message).hex() for message in sent)
    rows.append((f"Twists as rospy's own class writes them, of {TWISTS}", str(equal), equal == TWISTS))


def image_to_twist(bus: Any, rows: Rows) -> None:
    """Answer images with Twists; the peer takes the times."""
    send = bus.publisher("/answer", Twist, QoS())

    def answer(reception: Reception) -> None:
        image = reception.message
        assert isinstance(image, Image)
        send(Twist(Vector3(image.header.stamp.sec), Vector3(z=float(image.data[:9].sum()))))

    bus.subscribe("/image", Image, answer, QoS())
    with Peer("images", IMAGES) as peer:
        found = peer.read()
    p50, p99 = np.percentile(found["times"], [50, 99])
    what = f"Image of {found['bytes'] / 1e3:.0f} kB -> Twist"
    rows.append((f"{what}, right, of {IMAGES}", str(found["right"]), found["right"] == IMAGES))
    rows.append((f"{what}, p50 / p99", f"{p50:.2f} / {p99:.2f} ms", p50 <= 1.0))


def services(bus: Any, rows: Rows) -> None:
    """Call a service of the peer and answer one."""
    answers = [bus.call("/peer_set", SetBoolRequest(value), SetBoolResponse, 5.0) for value in (True, False)]
    right = [(each.success, each.message) for each in answers] == [(True, "peer ü"), (False, "peer ü")]
    rows.append(("SetBool of rospy, called by us", "both answers", right))

    def fail(request: Any) -> SetBoolResponse:
        raise ValueError("motor is hot")

    bus.serve("/our_set", SetBoolRequest, SetBoolResponse, lambda each: SetBoolResponse(each.data, "ours ü"))
    bus.serve("/our_fails", SetBoolRequest, SetBoolResponse, fail)
    with Peer("call") as peer:
        found = peer.read()
    right = found["answers"] == [[True, "ours ü"], [False, "ours ü"]] and "motor is hot" in found["failure"]
    rows.append(("SetBool of ours, called by rospy", "both answers", right))
    for name, word in (("/peer_fails", "failed"), ("/nobody", "Nobody"), ("/peer_late", "no answer")):
        refused(rows, f"call of {name}", BusError, word, lambda name=name: bus.call(
            name, SetBoolRequest(), SetBoolResponse, 1.0))  # fmt: skip


def actions(bus: Any, rows: Rows) -> None:
    """Run goals of actionlib's client, and send goals to actionlib's server: one ends, one is canceled."""

    def run(goal: Goal) -> Outcome:
        number = cast(TestGoal, goal.message).goal
        goal.feedback(TestFeedback(2 * number))
        if number < 0:
            goal.canceled.wait(10)
        return Outcome(GOAL_CANCELED if number < 0 else GOAL_SUCCEEDED, TestResult(3 * number))

    bus.serve_action("/our_action", TEST, run)
    with Peer("action_client") as peer:
        found = peer.read()
    rows.append(("actionlib's client of our action", str(found), found == [[3, 21, [14]], [2, -21]]))
    said: list[Any] = []
    with Peer("action_server") as peer:
        peer.read()
        ended = bus.send_goal("/peer_action", TEST, TestGoal(7), said.append).result(10)
        sent = bus.send_goal("/peer_action", TEST, TestGoal(-7), said.append)
        time.sleep(0.3)
        sent.cancel()
        canceled = sent.result(10)
    told = [(each.status, each.result.result) for each in (ended, canceled)], [each.feedback for each in said]
    right = told == ([(GOAL_SUCCEEDED, 21), (GOAL_CANCELED, -21)], [14, -14])
    rows.append(("our client of actionlib's server", str(told), right))


def topics_and_types(bus: Any, rows: Rows) -> None:
    """Another type is refused, two publishers are told, a latched message comes, malformed ones are left out."""
    got: list[Any] = []
    bus.subscribe("/latched", String, lambda each: got.append(each.message.data), QoS(latched=True))
    refused(rows, "another type", BusError, "carries std_msgs/msg/String, not geometry_msgs/msg/Twist",
            lambda: bus.publisher("/latched", Twist, QoS()))  # fmt: skip
    with Peer("publish", "/cmd_vel") as peer:
        peer.read()
        bus.publisher("/cmd_vel", Twist, QoS())
        found = next(info for info in bus.topics() if info.topic == "/cmd_vel")
    rows.append(("publishers of /cmd_vel", ", ".join(found.publishers), len(found.publishers) == 2))
    rows.append(("type of /cmd_vel", ", ".join(found.types), found.types == (Twist.TYPE,)))
    until = time.monotonic() + 5
    while not got and time.monotonic() < until:
        time.sleep(0.02)
    rows.append(("latched message of before", ", ".join(got), got == ["walls"]))
    junk: list[float] = []
    bus.subscribe("/junk", Twist, lambda each: junk.append(each.message.linear.x), QoS(depth=20))
    with Peer("malformed") as peer:
        peer.read()
        until = time.monotonic() + 5
        while not junk and time.monotonic() < until:
            time.sleep(0.02)
    left_out = sum(fault.count for fault in bus.faults() if fault.topic == "/junk")
    said = f"{left_out} left out, then {junk}"
    rows.append(("10 malformed messages, then a right one", said, said == "10 left out, then [0.5]"))


def inside(folder: Path) -> int:
    """Run all with rospy at hand; return the exit code."""
    rows: Rows = []
    without_a_master(rows)
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    master = Master(folder, dict(os.environ))
    try:
        os.environ["ROS_MASTER_URI"] = master.uri
        with Peer("echo") as peer:
            peer.read()
            began = time.monotonic()
            bus = open_bus(f"ros1:{master.uri}", "vlatool_check")
            rows.append(("opened in", f"{time.monotonic() - began:.2f} s", time.monotonic() - began < 5))
            rows.append(("the address that other nodes are told", os.environ["ROS_IP"], True))
            now = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
            rows.append(("signals are left alone", "", now == handlers))
            for check in (both_directions, one_direction, image_to_twist, services, actions, topics_and_types):
                check(bus, rows)
        ends(master, rows)
        rows.append(("stamp is now", "", abs(bus.stamp().seconds - time.time_ns() * 1e-9) < 0.1))
        master = kill_of_the_master(bus, master, folder, rows)
        began = time.monotonic()
        bus.close()
        rows.append(("closed in", f"{time.monotonic() - began:.2f} s", time.monotonic() - began < 2))
        left = ours(master)
        rows.append(("what the master knows of us after that", ", ".join(left) or "nothing", not left))
    finally:
        master.kill()
    for what, said, right in rows:
        print(f"{'ok  ' if right else 'FAIL'} {what:62} {said}")
    return int(not all(right for _, _, right in rows))


def ours(master: Master) -> list[str]:
    """Return the topics and services at which the master still has our node."""
    from vlatool.buses._ros1_master import ask

    state = ask(master.uri, "getSystemState", "/looker")
    return [name for part in state for name, nodes in part if "/vlatool_check" in nodes]


def main() -> None:
    """Prepare the folder, then run this script with ROS 1 at hand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ros1"), help="folder for ROS 1")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    folder = given.output.resolve()
    if given.inside:
        code = inside(folder)
        sys.stdout.flush()
        os._exit(code)
    again = [sys.executable, __file__, "--inside", "-o", str(folder)]
    sys.exit(subprocess.run(again, env=prepare(folder), check=False).returncode)


if __name__ == "__main__":
    main()
