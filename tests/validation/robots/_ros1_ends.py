"""Masters that are absent, mute or killed, and nodes that end, for ``ros1_bus.py``."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from _ros1 import Master, Peer, Rows, free_port, refused

from vlatool.buses import QoS, open_bus
from vlatool.errors import BusError, VlatoolError
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.ros1 import encode
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse


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
