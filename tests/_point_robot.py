"""A bus in memory, a robot that is a point on a plane, and controllers of it: small, whole, and without a library."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.buses import QoS, Reception, TopicInfo
from vlatool.buses._faults import Faults
from vlatool.controllers import Command, Input, Output, Service
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Point, Pose, PoseWithCovariance, Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.std_msgs import Bool, Header, String
from vlatool.worlds import Channel


class Exchange:
    """What the nodes of one memory share."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.handlers: dict[str, list[tuple[str, Any, Any]]] = {}
        self.publishers: dict[str, list[tuple[str, str]]] = {}
        self.services: dict[str, Any] = {}
        self.latched: dict[str, Any] = {}


class MemoryBus:
    """One node on an exchange; a handler is called in the thread of the sender."""

    def __init__(self, exchange: Exchange, node: str) -> None:
        self.exchange, self.node, self.closed = exchange, node, False
        self.counted = Faults()

    def subscribe(self, topic, message, handler, qos):
        with self.exchange.lock:
            self.exchange.handlers.setdefault(topic, []).append((self.node, message, handler))
            if qos.latched and topic in self.exchange.latched:
                handler(Reception(self.exchange.latched[topic], time.monotonic()))

    def publisher(self, topic, message, qos):
        self.exchange.publishers.setdefault(topic, []).append((self.node, message.TYPE))

        def send(value):
            if self.closed:
                raise BusError("The bus is closed.")
            if qos.latched:
                self.exchange.latched[topic] = value
            for _, wanted, handler in list(self.exchange.handlers.get(topic, ())):
                if wanted is type(value):
                    handler(Reception(value, time.monotonic()))

        return send

    def serve(self, service, request, response, handler):
        self.exchange.services[service] = handler

    def call(self, service, request, response, timeout_s):
        if service not in self.exchange.services:
            raise BusError(f"Nobody serves {service}.")
        return self.exchange.services[service](request)

    def topics(self):
        names = sorted({*self.exchange.handlers, *self.exchange.publishers})
        return [self._info(name) for name in names]

    def _info(self, topic):
        sending = self.exchange.publishers.get(topic, [])
        reading = self.exchange.handlers.get(topic, [])
        types = {kind for _, kind in sending} | {message.TYPE for _, message, _ in reading}
        return TopicInfo(topic, tuple(sorted(types)), tuple(node for node, _ in sending),
                         tuple(node for node, _, _ in reading))  # fmt: skip

    def faults(self):
        return self.counted.listing()

    def stamp(self):
        return Time.from_seconds(time.time())  # noqa: TID251

    def wait_for_peers(self, topics, timeout_s):
        return tuple(name for name in topics if name not in self.exchange.publishers)

    def close(self):
        self.closed = True


@dataclass
class PointWorld:
    """A point that moves as its Twist says, along x and y; odometry with noise at 50 Hz; it stops after 0.5 s."""

    noise: float = 0.01
    command_topic: str = "/cmd_vel"

    def __post_init__(self) -> None:
        self.reset(0)

    @property
    def sensors(self):
        return (Channel("/odom", Odometry, 50.0),)

    @property
    def commands(self):
        return (Channel(self.command_topic, Twist),)

    @property
    def time_s(self):
        return self._time

    def reset(self, seed):
        self._random = np.random.default_rng(seed)
        self._time, self._ticks, self._position = 0.0, 0, np.zeros(2)
        self._velocity, self._obeyed, self._reports = np.zeros(2), -1.0, []
        self._report()

    def _report(self):
        x, y = self._position + self._random.normal(0, self.noise, 2)
        pose = PoseWithCovariance(Pose(Point(float(x), float(y), 0.0)))
        stamp = Time.from_seconds(self._time)
        self._reports.append(("/odom", Odometry(Header(stamp, "odom"), "base", pose)))

    def advance(self, seconds):
        end = self._time + seconds
        while (self._ticks + 1) * 0.02 <= end + 1e-9:
            self._move((self._ticks + 1) * 0.02 - self._time)
            self._ticks += 1
            self._time = self._ticks * 0.02
            self._report()
        if end > self._time:
            self._move(end - self._time)
            self._time = end

    def _move(self, seconds):
        if self._time - self._obeyed <= 0.5:
            self._position = self._position + self._velocity * seconds

    def reports(self):
        found, self._reports = self._reports, []
        return found

    def obey(self, topic, message):
        self._velocity, self._obeyed = np.array([message.linear.x, message.linear.y]), self._time

    def truth(self):
        return {"x": float(self._position[0]), "y": float(self._position[1])}


@dataclass(frozen=True)
class GoTo:
    """Drives to a point; says when it is there."""

    goal_x: float = 1.0
    goal_y: float = 0.5
    speed: float = 0.4
    rate_hz: float = 10.0
    rough: bool = False
    words: tuple[str, ...] = ()
    inputs = (Input("odom", "/odom", Odometry),
              Input("instruction", "/instruction", String, depth=3, required=False))  # fmt: skip
    outputs = (Output("cmd", "/cmd_vel", Twist), Output("status", "/status", String))
    services = (Service("halt", "/halt", Bool, Bool),)

    def start(self):
        return {"halted": False, "seen": 0}

    def step(self, snapshot, state):
        halted, responses = state["halted"], {}
        for request in snapshot.requests:
            halted = request.message.data
            responses[request.number] = Bool(True)
        seen = state["seen"] + len(snapshot.readings.get("instruction", ()))
        odom = snapshot.message("odom", Odometry)
        if odom is None or halted:
            status = "halted" if halted else "waiting for /odom"
            return Command({"cmd": (Twist(),)}, responses, status), {"halted": halted, "seen": seen}
        position = odom.pose.pose.position
        away = np.array([self.goal_x - position.x, self.goal_y - position.y])
        far = float(np.hypot(*away))
        x, y = away / max(far, 1e-9) * min(self.speed, 2 * far)
        status = "there" if far < 0.05 else "going"
        messages = {"cmd": (Twist(Vector3(float(x), float(y))),), "status": (String(status),)}
        notes = {"x": position.x, "y": position.y, "distance": far, "seen": float(seen), "level": "normal"}
        return Command(messages, responses, status, notes), {"halted": halted, "seen": seen}

    def rest(self):
        return Command({"cmd": (Twist(),)}, status="at rest")


@dataclass(frozen=True)
class Limiter:
    """Passes a Twist on at half of its speed: the second of a chain."""

    factor: float = 0.5
    rate_hz: float = 20.0
    inputs = (Input("cmd_in", "/cmd_vel", Twist),)
    outputs = (Output("cmd_out", "/safe_cmd_vel", Twist),)
    services = ()

    def start(self):
        return 0

    def step(self, snapshot, state):
        came = snapshot.message("cmd_in", Twist)
        out = Twist() if came is None else Twist(Vector3(came.linear.x * self.factor, came.linear.y * self.factor))
        return Command({"cmd_out": (out,)}, status="passing"), state + 1

    def rest(self):
        return Command({"cmd_out": (Twist(),)})


@dataclass(frozen=True)
class Failing:
    """Raises at a step, sends what is asked of it before."""

    at: int = 3
    error: Any = None
    sends: Any = None
    rate_hz: float = 100.0
    sent: list[Any] = field(default_factory=list)
    inputs = ()
    outputs = (Output("cmd", "/cmd_vel", Twist),)
    services = ()

    def start(self):
        return 0

    def step(self, snapshot, state):
        if state == self.at:
            raise self.error or RuntimeError("the controller's own fault")
        return Command(self.sends or {"cmd": (Twist(Vector3(1.0)),)}), state + 1

    def rest(self):
        return Command({"cmd": (Twist(),)}, status="at rest")


def collect(bus: MemoryBus, topic: str, message: type[Message]) -> list[Any]:
    """Return a list that gets each message of a topic."""
    found: list[Any] = []
    bus.subscribe(topic, message, lambda got: found.append(got.message), QoS())
    return found
