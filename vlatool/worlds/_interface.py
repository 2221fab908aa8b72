"""What a simulated robot is: it takes commands and reports sensors, both as messages, by a clock of its own.

A controller meets the same messages as on the robot. The world does nothing by itself: whoever runs it advances its
clock, in step with a controller (``vlatool.nodes``), as fast as the processor allows, or in step with real time when
it is a process on a bus (``vlatool sim``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

from vlatool.messages import Message
from vlatool.registry import load


class Channel(NamedTuple):
    """A topic of a robot.

    Args:
        topic: Name, such as ``/scan``.
        message: Class of its messages.
        rate_hz: How often a sensor reports; 0 for a command.
    """

    topic: str
    message: type[Message]
    rate_hz: float = 0.0


@runtime_checkable
class World(Protocol):
    """A simulated robot in its surroundings; the class in ``vlatool/worlds/NAME.py`` is a dataclass of its knobs."""

    @property
    def sensors(self) -> tuple[Channel, ...]:
        """Topics that it reports."""

    @property
    def commands(self) -> tuple[Channel, ...]:
        """Topics that it obeys; each motor also stops when its command is silent for as long as the real one waits."""

    @property
    def time_s(self) -> float:
        """Simulated time since the reset, in seconds."""

    def reset(self, seed: int) -> None:
        """Start again, from a scene and noise of this seed."""

    def advance(self, seconds: float) -> None:
        """Simulate this much time."""

    def reports(self) -> list[tuple[str, Message]]:
        """Return the messages that sensors sent since the last call, with their topics, in order.

        Delay, loss, noise and frozen sensors are knobs of the world.
        """

    def obey(self, topic: str, message: Message) -> None:
        """Take a command."""

    def truth(self) -> Mapping[str, Any]:
        """Return what no sensor tells: poses, contacts, distances, in metres and radians, for tests and verdicts."""


def open_world(name: str, **knobs: Any) -> World:
    """Return a simulated robot by its name.

    Raises:
        UsageError: for an unknown one, or an unknown knob.
        MissingExtra: when MuJoCo or the robot's model is absent.
    """
    world: World = load("worlds", name)(**knobs)
    return world
