"""The bus ``ros1`` against the real rospy of Debian's packages: messages bit for bit, times, services, kills.

    python tests/validation/robots/ros1_bus.py -o out/ros1

Unpacks ROS 1 into the folder (2 MB from Debian, 30 MB from PyPI), starts masters on free ports, prints a table, and
exits with 1 when a line of it failed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _ros1 import Master, free_port, prepare

from vlatool.buses import QoS, Reception, open_bus
from vlatool.errors import BusError, VlatoolError
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.ros1 import encode
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import String
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse

HERE = Path(__file__).resolve().parent
TWISTS, IMAGES = 1000, 300
Rows = list[tuple[str, str, bool]]


class Peer:
    """A process with a node of rospy; a context."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, str(HERE / "_rospy_peer.py"), *map(str, arguments)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def read(self) -> Any:
        """Return the next line that it says."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                return json.loads(line)
        raise SystemExit("a peer ended without a word")

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()


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


def refused(rows: Rows, what: str, kind: type[Exception], word: str, attempt: Callable[[], object]) -> None:
    """Add a line: whether an attempt ended in an error with a word within 4 s."""
    began = time.monotonic()
    try:
        attempt()
        said = "nothing was raised"
    except kind as error:
        said = str(error).partition("\n")[0]
    seconds = time.monotonic() - began
    rows.append((f"{what}: {kind.__name__} in {seconds:.1f} s", said, word in said and seconds < 4))


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
    said = f"{bus.malformed.get('/junk', 0)} left out, then {junk}"
    rows.append(("10 malformed messages, then a right one", said, said == "10 left out, then [0.5]"))


def without_a_master(rows: Rows) -> None:
    """Open the bus where nobody, something mute, or something else listens."""
    refused(
        rows, "no master", BusError, "No ROS 1 master answers", lambda: open_bus(f"ros1:127.0.0.1:{free_port()}", "n")
    )
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        refused(
            rows,
            "a mute master",
            BusError,
            "nobody answered within 3 s",
            lambda: open_bus(f"ros1:127.0.0.1:{port}", "n"),
        )
    with socket.create_server(("127.0.0.1", 0)) as other:
        threading.Thread(target=talk, args=(other,), daemon=True).start()
        port = other.getsockname()[1]
        refused(rows, "an SSH server", BusError, "127.0.0.1", lambda: open_bus(f"ros1:127.0.0.1:{port}", "n"))
    refused(rows, "an impossible address", VlatoolError, "not the address", lambda: open_bus("ros1:11311", "n"))


def talk(server: socket.socket) -> None:
    """Say what an SSH server says."""
    with contextlib.suppress(OSError):
        while True:
            connection, _ = server.accept()
            connection.sendall(b"SSH-2.0-OpenSSH_9.2\r\n")
            connection.close()


def kill_of_the_master(bus: Any, master: Master, folder: Path, rows: Rows) -> Master:
    """Kill the master: what is connected goes on; then start another one on its port."""
    got: list[float] = []
    bus.subscribe("/alive", Twist, lambda each: got.append(each.received_s), QoS())
    with Peer("publish", "/alive") as peer:
        peer.read()
        bus.wait_for_peers(("/alive",), 5.0)
        master.kill()
        before = len(got)
        time.sleep(1.0)
        rows.append(
            ("messages in the second after kill -9 of the master", str(len(got) - before), len(got) - before >= 5)
        )
        refused(rows, "topics() meanwhile", BusError, "No ROS 1 master answers", bus.topics)
        refused(rows, "a new publisher meanwhile", BusError, "No ROS 1 master",
                lambda: bus.publisher("/later", Twist, QoS()))  # fmt: skip
    again = Master(folder, dict(os.environ), master.port)
    began = time.monotonic()
    while "/there" not in {info.topic for info in bus.topics()} and time.monotonic() < began + 10:
        time.sleep(0.05)
    seconds = time.monotonic() - began
    rows.append(("registered at the next master after", f"{seconds:.1f} s", seconds < 5))
    with Peer("publish", "/alive") as peer:
        peer.read()
        before, until = len(got), time.monotonic() + 5
        while len(got) == before and time.monotonic() < until:
            time.sleep(0.02)
    rows.append(("a node that comes then is heard", "", len(got) > before))
    answer = bus.call("/our_set", SetBoolRequest(True), SetBoolResponse, 5.0)
    rows.append(("our service is found then", "", answer.success))
    return again


def ends(master: Master, rows: Rows) -> None:
    """A process that forgets to close ends; one that sends and closes at once has sent; a namesake is refused."""
    begin = f"from vlatool.buses import open_bus, QoS\nfrom vlatool.messages.geometry_msgs import Twist, Vector3\n" \
            f"bus = open_bus('ros1:{master.uri}', 'other')\nsend = bus.publisher('/last', Twist, QoS())\n"  # fmt: skip
    with Peer("subscribe", "/last") as peer:
        peer.read()
        began = time.monotonic()
        forgets = subprocess.run(
            [sys.executable, "-c", f"{begin}bus.wait_for_peers(('/last',), 5)\n"], timeout=20, check=False
        )
        rows.append(
            (
                "a process that does not close the bus ends in",
                f"{time.monotonic() - began:.1f} s",
                not forgets.returncode,
            )
        )
        sends = "bus.wait_for_peers(('/last',), 5)\nsend(Twist(Vector3(0.25)))\nbus.close()\nbus.close()\n"
        subprocess.run([sys.executable, "-c", begin + sends], timeout=20, check=True)
        rows.append(
            ("what was sent just before close() arrived", "", peer.read() == encode(Twist(Vector3(0.25))).hex())
        )
        for name, attempt in (
            ("a second bus in a process", "open_bus(f'ros1', 'third')"),
            ("publishing after close()", "bus.close(); send(Twist())"),
        ):
            caught = f"try:\n    {attempt}\nexcept BusError as error:\n    print(error.message)\n"
            code = f"{begin}from vlatool.errors import BusError\n{caught}"
            said = subprocess.run(
                [sys.executable, "-c", code], timeout=20, check=True, capture_output=True, text=True
            ).stdout
            rows.append((name, said.strip().splitlines()[-1], "process" in said or "it was closed" in said))
    script = f"from vlatool.buses import open_bus\nopen_bus('ros1:{master.uri}', 'vlatool_check')"
    said = subprocess.run(
        [sys.executable, "-c", script], timeout=20, check=False, capture_output=True, text=True
    ).stderr
    rows.append(
        ("a second node of the same name", said.strip().splitlines()[-2][:90], "runs on this master already" in said)
    )


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
            now = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
            rows.append(("signals are left alone", "", now == handlers))
            for check in (both_directions, one_direction, image_to_twist, services, topics_and_types):
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
