"""A robot of four processes, a base, a controller, a safety monitor and a bus, that are killed and started again."""

from __future__ import annotations

import collections
import itertools
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from _ros1 import free_port, prepare

HERE = Path(__file__).resolve().parent
BUSES = ("zenoh", "zenoh-client", "dds", "ros1")
"""``zenoh-client``: nodes that are clients of the router, so that all that they say goes through it; those of ``zenoh``
are peers, as those of rmw_zenoh, and talk to each other."""
LEADS = {"roi-follower": (1.5, 0.25, "roi,info"), "cloud-follower": (1.05, 0.12, "cloud")}
"""Controller -> distance and largest bearing of its target, in metres and radians, at which it follows at nearly full
speed, and the sensors that it needs and the monitor does not."""
RESTING = 0.01
"""Speed below which the base stands, in m/s and rad/s."""
DRIVING = 0.2
"""Speed from which it drives, in m/s."""
FRESH_S = 0.3
"""Age of a tick up to which it says whether the robot drives now, on a busy processor."""
PATIENCE_S = 180.0
"""How long it may take until the robot drives."""
MOST_REFUSED = 20
MODULES = ("vlatool.cli", "vlatool.cli.run", "vlatool.nodes.session", "vlatool.controllers.safety_monitor",
           "vlatool.controllers.roi_follower", "vlatool.controllers.cloud_follower")  # fmt: skip
"""What ``vlatool run`` imports; and for each bus:"""
LIBRARIES = {"zenoh": ("vlatool.buses.zenoh", "zenoh", "zenoh.ext"), "dds": ("vlatool.buses.dds", "cyclonedds.core"),
             "ros1": ("vlatool.buses.ros1", "rospy")}  # fmt: skip
LIBRARIES["zenoh-client"] = LIBRARIES["zenoh"]


class State(NamedTuple):
    """What was true of the base at a tick: times in s (``time.monotonic``; simulated), m/s, rad/s, metres."""

    when_s: float
    simulated_s: float
    linear: float
    angular: float
    x: float
    y: float

    @property
    def stands(self) -> bool:
        """Whether it neither drives nor turns."""
        return abs(self.linear) < RESTING and abs(self.angular) < RESTING


class Rest(NamedTuple):
    """How the base came to rest: when its last stretch of standing began, how long that was (s), and ways (m).

    ``simulated_s`` is the time until then by its own clock, which falls behind where the processor is too slow;
    ``lasted_s`` is the shorter one of both clocks.
    """

    began_s: float
    simulated_s: float
    lasted_s: float
    way_m: float
    moved_m: float


def last_rest(states: list[State]) -> Rest | None:
    """Return the stretch of standing at the end of some states, with the way until it and within it; None without."""
    first = len(states)
    while first and states[first - 1].stands:
        first -= 1
    if first == len(states):
        return None
    pairs = itertools.pairwise(states[: first + 1])
    way = sum(math.hypot(after.x - before.x, after.y - before.y) for before, after in pairs)
    moved = max(math.hypot(each.x - states[first].x, each.y - states[first].y) for each in states[first:])
    simulated_s = states[first].simulated_s - states[0].simulated_s
    lasted_s = elapsed_s(states[first:])
    return Rest(states[first].when_s, simulated_s, lasted_s, way, moved)


def elapsed_s(states: list[State]) -> float:
    """Return the time from the first to the last of some states, in s: the shorter one of both clocks."""
    return min(states[-1].when_s - states[0].when_s, states[-1].simulated_s - states[0].simulated_s)


class Nursery:
    """Starts processes on one bus without the time that their imports take; see ``_warm_start.py``."""

    def __init__(self, modules: Iterable[str], environment: dict[str, str]) -> None:
        command = [sys.executable, HERE / "_warm_start.py", *modules]
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def start(self, errors: Path, environment: dict[str, str], command: Iterable[object]) -> int:
        """Start a process, and return its number."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("a nursery without pipes")
        stdin.write(json.dumps([str(errors), environment, *map(str, command)]) + "\n")
        stdin.flush()
        return int(stdout.readline())

    def end(self) -> None:
        """End it, and with it what it has started."""
        self._process.kill()
        self._process.communicate()


class Node:
    """A process that is started, killed and started again; what it says on stderr is in a file.

    Args:
        name: What it is for the robot.
        environment: Variables beside those of the nursery.
        command: Its command line without the interpreter.
    """

    def __init__(
        self, name: str, nursery: Nursery, folder: Path, environment: dict[str, str], command: Iterable[object]
    ) -> None:
        self.name, self._nursery, self._environment, self._command = name, nursery, environment, [*command]
        self._errors = folder / f"{name}.stderr"
        self.alive = False
        """Whether it has been started since it was last killed."""
        self.start()

    def start(self) -> None:
        """Start it."""
        self._number = self._nursery.start(self._errors, self._environment, self._command)
        self.alive = True

    def kill(self) -> float:
        """Kill it as ``kill -9`` does, and return when."""
        when = time.monotonic()
        os.kill(self._number, signal.SIGKILL)
        self.alive = False
        return when

    def ended(self) -> str:
        """Return how it ended by itself; empty while it runs."""
        try:
            os.kill(self._number, 0)
        except ProcessLookupError:
            return f"{self.name} ended: {self._errors.read_text()[-300:].strip()}"
        return ""


class Robot:
    """The processes on one bus; a context. None of them is started for its caller before the ones it needs.

    Args:
        bus: One of ``BUSES``.
        controller: One of ``LEADS``.
        folder: Where stderr and settings go; that of ROS 1 is beside it.
        number: Number of this robot: of its seed, and its DDS domain.
    """

    def __init__(self, bus: str, controller: str, folder: Path, number: int, ros1: Path) -> None:
        self.bus = bus
        self.refused: list[str] = []
        """How processes ended that were started and not killed."""
        self._states: collections.deque[State] = collections.deque(maxlen=20_000)
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._port = folder, free_port()
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
        if bus == "ros1":
            environment = {**prepare(ros1), "OMP_NUM_THREADS": "1", "ROS_IP": "127.0.0.1"}
        own: dict[str, str] = {}
        if bus == "zenoh-client":
            own = {"ZENOH_SESSION_CONFIG_URI": str(client_settings(folder, self._port))}
        domain = 100 + (os.getpid() + number) % 100
        addresses = {"dds": f"dds:{domain}@127.0.0.1", "ros1": f"ros1:http://127.0.0.1:{self._port}"}
        address = addresses.get(bus, f"zenoh:tcp/127.0.0.1:{self._port}")
        self._nursery = Nursery([*MODULES, *LIBRARIES[bus]], environment)
        self.nodes: dict[str, Node] = {}
        self._world: subprocess.Popen[str] | None = None
        try:
            self._start_hub(ros1)
            distance, bearing, sensors = LEADS[controller]
            command = [sys.executable, HERE / "_driven_world.py", address, distance, bearing, number, sensors]
            self._world = subprocess.Popen(
                list(map(str, command)), env=environment | own, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            self._reader = threading.Thread(target=self._read, args=(self._world,), daemon=True)
            self._reader.start()
            common = ["--bus", address, *(["--shared"] if bus == "dds" else [])]
            for name, what in (("monitor", "safety-monitor"), ("controller", controller)):
                run = ["-m", "vlatool", "run", what, *common]
                self.nodes[name] = Node(name, self._nursery, folder, own, run)
        except BaseException:
            self.__exit__()
            raise

    def _start_hub(self, ros1: Path) -> None:
        """Start the process that is the bus, where there is one, and wait until it listens."""
        hub = {"ros1": [ros1 / "root/usr/bin/rosmaster", "--core", "-p", self._port], "dds": []}.get(
            self.bus, [HERE / "_zenoh_router.py", f"zenoh:router/tcp/127.0.0.1:{self._port}"]
        )
        if not hub:
            return
        self.nodes["bus"] = Node("bus", self._nursery, self._folder, {}, hub)
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until and not self.nodes["bus"].ended():
            with socket.socket() as attempt:
                if attempt.connect_ex(("127.0.0.1", self._port)) == 0:
                    return
            time.sleep(0.05)
        raise SystemExit(f"the bus did not start: {self.nodes['bus'].ended()}")

    def _read(self, world: subprocess.Popen[str]) -> None:
        for line in world.stdout or ():
            self._states.append(State(*map(float, line.split())))

    def since(self, moment_s: float) -> list[State]:
        """Return what was true from the last tick before a moment on."""
        states = list(self._states)
        first = len(states)
        while first and states[first - 1].when_s > moment_s:
            first -= 1
        return states[max(0, first - 1) :]

    def drive(self, then_s: float) -> State:
        """Wait until the robot drives, and goes on doing so for some seconds; return the last state.

        Nodes that were refused, as their predecessors still seemed to be there, are started again; an emergency is
        released, as an operator does.
        """
        until, released, since = time.monotonic() + PATIENCE_S, time.monotonic(), None
        while time.monotonic() < until:
            time.sleep(0.01)
            now, last = time.monotonic(), self._states[-1] if self._states else None
            if last is not None and now - last.when_s < FRESH_S and last.linear >= DRIVING:
                since = since or now
                if now - since >= then_s:
                    return last
                continue
            since = None
            for node in self.nodes.values():
                if ended := node.ended():
                    self.refused.append(ended)
                    if len(self.refused) > MOST_REFUSED:
                        raise SystemExit(ended)
                    time.sleep(0.5)
                    node.start()
            if now - released > 1.5 and last is not None and last.stands:
                released = now
                self._release()
        ends = [node.ended() or f"{node.name} runs" for node in self.nodes.values()]
        raise SystemExit(f"the robot does not drive within {PATIENCE_S:g} s: {'; '.join(ends)}")

    def _release(self) -> None:
        if self._world is not None and self._world.stdin is not None:
            self._world.stdin.write("release\n")
            self._world.stdin.flush()

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        self._nursery.end()
        if self._world is not None:
            self._world.kill()
            self._world.wait()
            self._reader.join()
            for stream in (self._world.stdin, self._world.stdout):
                if stream is not None:
                    stream.close()


def client_settings(folder: Path, port: int) -> Path:
    """Write settings of a client of Zenoh, as ``ZENOH_SESSION_CONFIG_URI`` names them, and return their file."""
    file = folder / "client.json5"
    settings = {
        "mode": "client", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "scouting": {"multicast": {"enabled": False}}, "timestamping": {"enabled": True},
    }  # fmt: skip
    file.write_text(json.dumps(settings))
    return file
