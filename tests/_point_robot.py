"""A point on a line: a world, a controller that drives it to a goal, one that limits its speed, and a bus in memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.buses import QoS, Reception, TopicInfo
from vlatool.controllers import Command, Input, Output, Service, Snapshot
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Point, Pose, PoseWithCovariance, Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.std_msgs import Bool, String
from vlatool.worlds import Channel

ODOMETRY_HZ = 50.0


@dataclass
class PointWorld:
    """A point that obeys /cmd_vel, and stops when it has been silent for half a second."""

    noise: float = 0.001
    sensors: tuple[Channel, ...] = (Channel("/odom", Odometry, ODOMETRY_HZ),)
    commands: tuple[Channel, ...] = (Channel("/cmd_vel", Twist),)
    _x: float = 0.0
    _v: float = 0.0
    _told_s: float = -1.0
    _reported: int = 0
    time_s: float = 0.0
    _random: Any = None

    def reset(self, seed: int) -> None:
        self._x, self._v, self._told_s, self._reported, self.time_s = 0.0, 0.0, -1.0, 0, 0.0
        self._random = np.random.default_rng(seed)

    def advance(self, seconds: float) -> None:
        if self.time_s - self._told_s > 0.5:
            self._v = 0.0
        self._x += self._v * seconds
        self.time_s += seconds

    def reports(self) -> list[tuple[str, Message]]:
        found: list[tuple[str, Message]] = []
        while self._reported / ODOMETRY_HZ <= self.time_s + 1e-9:
            self._reported += 1
            x = self._x + float(self._random.normal()) * self.noise
            found.append(("/odom", Odometry(pose=PoseWithCovariance(pose=Pose(position=Point(x=x))))))
        return found

    def obey(self, topic: str, message: Message) -> None:
        assert topic == "/cmd_vel"
        assert isinstance(message, Twist)
        self._v, self._told_s = message.linear.x, self.time_s

    def truth(self) -> Mapping[str, Any]:
        return {"x": self._x, "v": self._v}


@dataclass(frozen=True)
class GoTo:
    """Drives to a goal; fails at ``fail_at`` if that is a step, and takes ``slow_s`` for each."""

    goal: float = 1.0
    fail_at: int = -1
    slow_s: float = 0.0
    rate_hz: float = 20.0
    inputs: tuple[Input, ...] = (
        Input("odometry", "/odom", Odometry, depth=8),
        Input("note", "/note", String, required=False),
    )
    outputs: tuple[Output, ...] = (Output("velocity", "/cmd_vel", Twist),)
    services: tuple[Service, ...] = (Service("hold", "/hold", Bool, String),)

    def start(self) -> int:
        return 0

    def step(self, snapshot: Snapshot, state: int) -> tuple[Command, int]:
        if state == self.fail_at:
            raise ValueError("planted")
        if self.slow_s:
            time.sleep(self.slow_s)
        answers = {request.number: String(data=f"step {state}") for request in snapshot.requests}
        odometry = snapshot.message("odometry", Odometry)
        if odometry is None:
            return Command(responses=answers, status="waiting for odometry"), state + 1
        speed = float(np.clip(2 * (self.goal - odometry.pose.pose.position.x), -0.5, 0.5))
        return Command({"velocity": (Twist(linear=Vector3(x=speed)),)}, answers, "driving", {"speed": speed}), state + 1

    def rest(self) -> Command:
        return Command({"velocity": (Twist(),)}, status="at rest")


@dataclass(frozen=True)
class Limiter:
    """Passes a velocity on, at most ``limit`` m/s."""

    limit: float = 0.2
    rate_hz: float = 50.0
    inputs: tuple[Input, ...] = (Input("wanted", "/cmd_vel_wanted", Twist, depth=4),)
    outputs: tuple[Output, ...] = (Output("velocity", "/cmd_vel", Twist),)
    services: tuple[Service, ...] = ()

    def start(self) -> None:
        return None

    def step(self, snapshot: Snapshot, state: None) -> tuple[Command, None]:
        wanted = snapshot.message("wanted", Twist) or Twist()
        x = min(max(wanted.linear.x, -self.limit), self.limit)
        return Command({"velocity": (Twist(linear=Vector3(x=x)),)}, status="limiting"), state

    def rest(self) -> Command:
        return Command({"velocity": (Twist(),)})


@dataclass
class MemoryBus:
    """A bus inside one process: handlers are called by who publishes."""

    handlers: dict[str, list[Callable[[Reception], None]]] = field(default_factory=dict)
    types: dict[str, type[Message]] = field(default_factory=dict)
    sent: dict[str, list[Message]] = field(default_factory=dict)
    services: dict[str, Callable[[Message], Message]] = field(default_factory=dict)
    closed: bool = False

    def _check(self, topic: str, message: type[Message]) -> None:
        if self.types.setdefault(topic, message) is not message:
            raise BusError(f"{topic} carries {self.types[topic].TYPE}, not {message.TYPE}.", "map another topic")

    def subscribe(self, topic: str, message: type[Any], handler: Callable[[Reception], None], qos: QoS) -> None:
        self._check(topic, message)
        self.handlers.setdefault(topic, []).append(handler)

    def publisher(self, topic: str, message: type[Any], qos: QoS) -> Callable[[Any], None]:
        self._check(topic, message)

        def publish(sent: Any) -> None:
            self.sent.setdefault(topic, []).append(sent)
            for handler in self.handlers.get(topic, ()):
                handler(Reception(sent, time.monotonic()))

        return publish

    def serve(self, service: str, request: Any, response: Any, handler: Callable[[Any], Any]) -> None:
        self.services[service] = handler

    def call(self, service: str, request: Message, response: Any, timeout_s: float) -> Any:
        return self.services[service](request)

    def topics(self) -> list[TopicInfo]:
        return [TopicInfo(topic, (message.TYPE,)) for topic, message in sorted(self.types.items())]

    def stamp(self) -> Time:
        return Time.from_seconds(time.time())

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        return ()

    def close(self) -> None:
        self.closed = True
