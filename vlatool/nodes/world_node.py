"""A simulated robot as a process on a bus: its clock goes in step with real time, its stamps are those of the bus."""

from __future__ import annotations

import dataclasses
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vlatool.buses import Bus, QoS, Reception
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.sensor_msgs import Image, PointCloud2
from vlatool.worlds import Channel, World

TICK_S = 0.01
"""Simulated time between two looks at the commands and the sensors."""
MAX_BEHIND_S = 0.25
"""Simulated time that is caught up on at most; what is beyond it is given up and counted."""
MAX_COMMANDS = 100
SENSOR_QOS = QoS(reliable=True)
"""Of a sensor: subscribers that ask for reliable hear nobody who does not offer it, and others hear both."""
LARGE_QOS = QoS()
"""Of pictures and clouds: what a subscriber that stands still has not acknowledged would hold the robot."""
LATCHED_QOS = QoS(reliable=True, latched=True)
"""Of a topic that a robot sends once, such as its task, for nodes that come later."""


@dataclass
class WorldSummary:
    """What a simulated robot did.

    Args:
        seconds: Simulated time.
        reports: Messages that its sensors sent.
        commands: Commands that it obeyed.
        behind_s: Real time that the processor was too slow for, in seconds.
    """

    seconds: float = 0.0
    reports: int = 0
    commands: int = 0
    behind_s: float = 0.0


class WorldNode:
    """A simulated robot on a bus.

    Args:
        world: The robot, which is reset with the seed.
        bus: The bus; whoever opened it closes it.
        seed: Seed of its scene and noise.

    Raises:
        BusError: when a topic carries another type.
    """

    def __init__(self, world: World, bus: Bus, seed: int = 0) -> None:
        self.world, self.bus, self.summary = world, bus, WorldSummary()
        self._stop = threading.Event()
        self._commands: queue.Queue[tuple[str, Message]] = queue.Queue(MAX_COMMANDS)
        world.reset(seed)
        self._senders = {
            channel.topic: bus.publisher(channel.topic, channel.message, _quality_of(channel))
            for channel in world.sensors
        }
        for channel in world.commands:
            bus.subscribe(channel.topic, channel.message, self._taker(channel.topic), QoS(reliable=True, depth=10))

    def _taker(self, topic: str) -> Callable[[Reception], None]:
        def take(got: Reception) -> None:
            while True:
                try:
                    self._commands.put_nowait((topic, got.message))
                    return
                except queue.Full:  # the oldest gives way
                    self._drop()

        return take

    def _drop(self) -> None:
        try:
            self._commands.get_nowait()
        except queue.Empty:
            return

    def stop(self) -> None:
        """Let ``run`` end; may be called from any thread."""
        self._stop.set()

    def run(self, seconds: float | None = None, observer: Callable[[World], None] | None = None) -> WorldSummary:
        """Simulate in step with real time until the time is over or ``stop`` is called.

        Args:
            seconds: Simulated time; without an end when None.
            observer: Called with the world after each tick.
        """
        epoch_s = self.bus.stamp().seconds - self.world.time_s
        start_s, begin = self.world.time_s, time.monotonic()
        while seconds is None or self.world.time_s - start_s < seconds - TICK_S / 2:
            ahead = begin + (self.world.time_s - start_s) + TICK_S - time.monotonic()
            if self._stop.wait(max(0.0, ahead)):
                break
            if ahead < -MAX_BEHIND_S:
                begin -= ahead
                self.summary.behind_s -= ahead
                epoch_s -= ahead
            self._tick(epoch_s)
            if observer is not None:
                observer(self.world)
        self.summary.seconds = self.world.time_s - start_s
        return self.summary

    def _tick(self, epoch_s: float) -> None:
        while not self._commands.empty():
            self.world.obey(*self._commands.get_nowait())
            self.summary.commands += 1
        self.world.advance(TICK_S)
        for topic, message in self.world.reports():
            self._senders[topic](restamp(message, epoch_s))
            self.summary.reports += 1


def _quality_of(channel: Channel) -> QoS:
    if not channel.rate_hz:
        return LATCHED_QOS
    return LARGE_QOS if channel.message in (Image, PointCloud2) else SENSOR_QOS


def restamp(message: Any, epoch_s: float) -> Any:
    """Return a message whose stamp, in simulated seconds, is that many seconds later: by the clock of the bus."""
    header = getattr(message, "header", None)
    if header is None:
        return message
    stamp = Time.from_seconds(header.stamp.seconds + epoch_s)
    return dataclasses.replace(message, header=dataclasses.replace(header, stamp=stamp))
