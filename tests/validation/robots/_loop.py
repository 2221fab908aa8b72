"""Controllers and a simulated robot in step: a small loop that carries messages between them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from vlatool.controllers import Command, Reading, Snapshot
from vlatool.controllers._interface import Request, RobotController
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.worlds import World

TICK_S = 0.05


class Node:
    """A controller, what came for it, and its state."""

    def __init__(self, controller: RobotController[Any]) -> None:
        self.controller, self.state = controller, controller.start()
        self.names = {entry.topic: entry for entry in controller.inputs}
        self.topics = {entry.name: entry.topic for entry in controller.outputs}
        self.newest: dict[str, Reading] = {}
        self.waiting: dict[str, list[Reading]] = {}
        self.requests: list[Request] = []
        self.every = round(1.0 / controller.rate_hz / TICK_S)
        self.command = Command()

    def deliver(self, topic: str, message: Message, now_s: float) -> None:
        if topic in self.names:
            entry = self.names[topic]
            count = self.newest[entry.name].sequence + 1 if entry.name in self.newest else 0
            self.newest[entry.name] = Reading(message, now_s, count)
            self.waiting[entry.name] = [*self.waiting.get(entry.name, []), self.newest[entry.name]][-entry.depth :]

    def step(self, now_s: float) -> list[tuple[str, Message]]:
        readings = {name: tuple(found) for name, found in self.waiting.items()}
        snapshot = Snapshot(now_s, Time.from_seconds(now_s), readings, dict(self.newest), tuple(self.requests))
        self.waiting, self.requests = {}, []
        self.command, self.state = self.controller.step(snapshot, self.state)
        return [(self.topics[name], m) for name, found in self.command.messages.items() for m in found]


class Loop:
    """A world and its controllers, 20 times a second; messages between controllers arrive in the same tick.

    Args:
        world: The robot, after its reset.
        controllers: In the order of their steps.
        alter: Changes or drops a message on its way from the world: (topic, message) -> message or None.
    """

    def __init__(
        self, world: World, controllers: Iterable[RobotController[Any]], alter: Callable[..., Any] | None = None
    ):
        self.world, self.nodes, self.alter, self.tick = world, [Node(one) for one in controllers], alter, 0
        self.obeys = {channel.topic for channel in world.commands}

    def publish(self, topic: str, message: Message) -> None:
        for node in self.nodes:
            node.deliver(topic, message, self.world.time_s)
        if topic in self.obeys:
            self.world.obey(topic, message)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            for topic, message in self.world.reports():
                changed = self.alter(topic, message) if self.alter else message
                if changed is not None:
                    self.publish(topic, changed)
            for node in self.nodes:
                if self.tick % node.every == 0:
                    for topic, message in node.step(self.world.time_s):
                        self.publish(topic, message)
            self.world.advance(TICK_S)
            self.tick += 1
