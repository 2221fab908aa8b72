"""What tests of buses share: nodes that meet, and messages that are waited for."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from vlatool.buses import Bus, QoS, Reception
from vlatool.messages import Message
from vlatool.messages.geometry_msgs import Twist, Vector3

QUALITY = QoS(reliable=True, depth=10)
WAIT_S = 10.0
"""How long anything may take on a loaded machine."""


def forward(speed: float) -> Twist:
    """A Twist with this speed."""
    return Twist(linear=Vector3(speed, 0.0, 0.0))


def speeds(messages: list[Any]) -> list[float]:
    """The speeds of Twists."""
    return [message.linear.x for message in messages]


def free_port() -> int:
    """A port of this machine that is free now."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])


def wait_until(condition: Callable[[], bool], within_s: float = WAIT_S) -> bool:
    """Whether a condition holds within a time."""
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


class Heard:
    """Messages that a subscription got; may block in its handler until ``go``."""

    def __init__(
        self, bus: Bus, topic: str, cls: type[Message] = Twist, qos: QoS = QUALITY, blocks: bool = False
    ) -> None:
        self.messages: list[Any] = []
        self.receptions: list[Reception] = []
        self.busy, self.go = threading.Event(), threading.Event()
        self._blocks = blocks
        bus.subscribe(topic, cls, self._take, qos)

    def _take(self, reception: Reception) -> None:
        self.busy.set()
        if self._blocks:
            self.go.wait(WAIT_S)
        self.receptions.append(reception)
        self.messages.append(reception.message)

    def has(self, count: int) -> bool:
        """Whether so many messages come in time."""
        return wait_until(lambda: len(self.messages) >= count)
