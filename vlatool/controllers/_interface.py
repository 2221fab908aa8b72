"""What a robot controller is: ``step(snapshot, state) -> (command, state)``, and the values that pass through it.

A controller holds settings alone, as a frozen dataclass: its fields are what a JSON file on the robot and the flags of
``vlatool run`` set. No bus, clock, thread or file is inside, so simulation, replay and robot run the same bytes. What
changes from step to step is in the state, a frozen value of the controller's own type that only it reads.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time

S = TypeVar("S")
M = TypeVar("M", bound=Message)


@dataclass(frozen=True)
class Input:
    """A topic that a controller reads.

    Args:
        name: Name of the input in the controller.
        topic: Topic, unless the user maps another.
        message: Class of its messages.
        depth: How many of the messages that came since the last step a snapshot holds; 1 for the newest alone.
        required: Whether the controller, or its policy, does nothing until a message has come.
        reliable: Whether the transport repeats what is lost; sensors do not ask for it.
        latched: Whether a message of before the start is wanted (ROS 2: transient local).
    """

    name: str
    topic: str
    message: type[Message]
    depth: int = 1
    required: bool = True
    reliable: bool = False
    latched: bool = False


@dataclass(frozen=True)
class Output:
    """A topic that a controller writes; see ``Input``."""

    name: str
    topic: str
    message: type[Message]
    reliable: bool = True
    latched: bool = False


@dataclass(frozen=True)
class Service:
    """A service that a controller answers.

    Args:
        name: Name of the service in the controller.
        service: Name on the bus, unless the user maps another.
        request: Class of its requests.
        response: Class of its responses.
        answer_s: How long a caller waits for a step that answers, in seconds; then the call fails.
    """

    name: str
    service: str
    request: type[Message]
    response: type[Message]
    answer_s: float = 5.0


class Reading(NamedTuple):
    """A message that came.

    Args:
        message: The message.
        received_s: When it came, by the clock of ``Snapshot.time_s``, in seconds.
        sequence: How many came on this input before it.
    """

    message: Message
    received_s: float
    sequence: int


class Request(NamedTuple):
    """A call of a service.

    Args:
        service: ``Service.name``.
        message: The request.
        number: Which call it is; the response carries the same.
    """

    service: str
    message: Message
    number: int


@dataclass(frozen=True)
class Snapshot:
    """What a controller knows at a step.

    Args:
        time_s: Time of the step by a clock that never jumps, in seconds from any start.
        stamp: The same moment by the clock that stamps messages: it may jump.
        readings: Input -> messages that came since the last step, the oldest first, at most ``Input.depth``.
        newest: Input -> newest message so far; an input without one is absent.
        requests: Calls of services since the last step, in order.
    """

    time_s: float
    stamp: Time = Time()
    readings: Mapping[str, tuple[Reading, ...]] = field(default_factory=dict)
    newest: Mapping[str, Reading] = field(default_factory=dict)
    requests: tuple[Request, ...] = ()

    def message(self, name: str, message: type[M]) -> M | None:
        """Return the newest message of an input, or None if none has come."""
        reading = self.newest.get(name)
        return reading.message if reading is not None and isinstance(reading.message, message) else None

    def age_s(self, name: str) -> float:
        """Return how long ago the newest message of an input came, in seconds; infinity if none has come."""
        reading = self.newest.get(name)
        return float("inf") if reading is None else self.time_s - reading.received_s


@dataclass(frozen=True)
class Command:
    """What a controller wants at a step.

    Args:
        messages: Output -> messages to send, in order; an output that is absent stays silent.
        responses: Number of a request -> its response; a request that is absent is answered at a later step.
        status: What it does, in a word or two, such as ``following`` or ``waiting for /scan``.
        notes: Values for the record of the run, such as distances and levels: name -> number or text.
    """

    messages: Mapping[str, tuple[Message, ...]] = field(default_factory=dict)
    responses: Mapping[int, Message] = field(default_factory=dict)
    status: str = ""
    notes: Mapping[str, float | str] = field(default_factory=dict)


@runtime_checkable
class RobotController(Protocol[S]):
    """Maps what a robot reports to what it should do.

    A class in ``vlatool/controllers/NAME.py`` is a frozen dataclass whose fields are its settings. One that needs a
    policy has the field ``policy: Controller | None = field(default=None, metadata={"setting": False})``, which
    ``with_policy`` sets: what ``vlatool.load(...)`` returns, with its deadline and envelope on.
    """

    @property
    def rate_hz(self) -> float:
        """Steps in a second."""

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Topics that it reads."""

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Topics that it writes."""

    @property
    def services(self) -> tuple[Service, ...]:
        """Services that it answers."""

    def start(self) -> S:
        """Return the state before the first step; a policy is reset."""

    def step(self, snapshot: Snapshot, state: S) -> tuple[Command, S]:
        """Return what to do now, and the state for the next step.

        The same snapshot and state give the same command, bit for bit. It never raises for what a sensor sends: NaN, an
        empty cloud, an unknown encoding or a stamp of tomorrow ends in a safe command and a status that names it.
        """

    def rest(self) -> Command:
        """Return what stops the robot when the controller ends or fails."""


def with_policy(controller: Any, policy: Any) -> Any:
    """Return the controller with a policy: what ``vlatool.load`` returned."""
    return dataclasses.replace(controller, policy=policy)
