"""What a bus is: publish, subscribe, services, and a list of what is there.

A bus carries messages of ``vlatool.messages`` under ROS 2 names: topics such as ``/cmd_vel``, types such as
``geometry_msgs/msg/Twist``. Handlers are called in a thread of the bus, one at a time for each subscription, and must
return soon; the run of a controller (``vlatool.nodes``) puts what they get into its inbox.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from vlatool.buses._ros_words import RosWords
from vlatool.errors import BusError, UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.registry import load

M = TypeVar("M", bound=Message)


@dataclass(frozen=True)
class QoS:
    """Quality of service, in ROS 2's terms.

    Args:
        reliable: Reliable, else best effort. ROS 1 is always reliable.
        depth: How many messages wait at most.
        latched: Transient local, else volatile: a subscriber that comes later gets the last message.
    """

    reliable: bool = False
    depth: int = 1
    latched: bool = False


class Reception(NamedTuple):
    """A message that came.

    Args:
        message: The message; its arrays may be read-only views of what the transport received.
        received_s: When it came, by ``time.monotonic``, in seconds; in a simulation, by the simulated clock.
    """

    message: Message
    received_s: float


@dataclass(frozen=True)
class TopicInfo:
    """A topic on a bus.

    Args:
        topic: Name, such as ``/cmd_vel``.
        types: ROS 2 names of the types that its publishers and subscribers state; several are a fault.
        publishers: Names of the nodes that publish it, or of their addresses where a bus knows no more.
        subscribers: Names of those that subscribe to it.
    """

    topic: str
    types: tuple[str, ...] = ()
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fault:
    """What went wrong on a topic or a service while its messages were handled.

    Args:
        topic: The topic or service.
        count: How often something went wrong there.
        error: The latest error.
    """

    topic: str
    count: int
    error: BusError


@runtime_checkable
class Bus(Protocol):
    """A connection of one node to a bus; the class in ``vlatool/buses/NAME.py`` is built as ``NAME(address, node)``."""

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """Call ``handler`` with each message of a topic.

        Raises:
            BusError: when the topic carries another type.
        """

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """Announce a topic and return what sends a message on it; it never blocks."""

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """Answer a service."""

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """Call a service and return its answer.

        Raises:
            BusError: when nobody answers in time.
        """

    def topics(self) -> list[TopicInfo]:
        """Return what is on the bus now, this node's own included, sorted by name."""

    def faults(self) -> list[Fault]:
        """Return what went wrong so far, one entry for each topic or service, sorted by name.

        Malformed messages, errors that handlers raise, and another type that appears on a topic later are counted
        here; none of them stops the bus.
        """

    def stamp(self) -> Time:
        """Return the moment by the clock that stamps this bus's messages."""

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """Wait until each topic has a peer: a publisher, or a subscriber; return those without."""

    def close(self) -> None:
        """Leave the bus; what is sent has left this process. Closing twice does nothing."""


GOAL_SUCCEEDED, GOAL_CANCELED, GOAL_ABORTED = "succeeded", "canceled", "aborted"
"""How a goal of an action ends."""


class ActionType(NamedTuple):
    """Type of an action.

    Args:
        name: ROS 2 name, such as ``vlatool_msgs/action/RunInstruction``.
        goal: Class of its goals.
        feedback: Class of what it reports meanwhile.
        result: Class of what it reports at the end.
    """

    name: str
    goal: type[Message]
    feedback: type[Message]
    result: type[Message]


class Outcome(NamedTuple):
    """How a goal ended: ``GOAL_SUCCEEDED``, ``GOAL_CANCELED`` or ``GOAL_ABORTED``, and the result."""

    status: str
    result: Message


@dataclass(frozen=True)
class Goal:
    """A goal of an action, as its server sees it.

    Args:
        message: The goal.
        feedback: Sends feedback to the client.
        canceled: Set when the client cancels the goal, a newer goal replaces it, or the bus closes.
    """

    message: Message
    feedback: Callable[[Message], None]
    canceled: threading.Event


@runtime_checkable
class ClientGoal(Protocol):
    """A goal of an action, as its client sees it."""

    def result(self, timeout_s: float) -> Outcome:
        """Wait for the end of the goal.

        Raises:
            BusError: when it is not reached in time, or the server refuses the goal.
        """

    def cancel(self) -> None:
        """Ask the server to cancel the goal; ``result`` tells how it ended."""


@runtime_checkable
class ActionBus(Bus, Protocol):
    """A bus that also has actions: goals that take a while, report meanwhile and can be canceled."""

    def serve_action(self, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        """Answer an action.

        ``handler`` runs in a thread of its own until the goal ends, and looks at ``Goal.canceled`` meanwhile. One goal
        runs at a time: a newer one cancels that which runs, and starts when its handler has returned. A handler that
        raises ends its goal as aborted, with an empty result.
        """

    def send_goal(
        self, action: str, kind: ActionType, goal: Message, feedback: Callable[[Message], None] | None = None
    ) -> ClientGoal:
        """Send a goal; ``feedback`` is called with what the server reports meanwhile.

        Raises:
            BusError: when nobody serves the action.
        """


@runtime_checkable
class NamingBus(Protocol):
    """A bus whose library may call the node and its topics otherwise than they are written: that of ROS."""

    full_node: str
    """Name of the node with its namespace, without a slash before it: ``robot1/vlatool_vln``."""

    def resolve(self, name: str) -> str:
        """Return the full name that a topic or service has on the bus, after remappings."""


def name_on(bus: Bus, name: str) -> str:
    """Return the name that a topic or service has on a bus: that which is written, unless the bus gives it another."""
    return bus.resolve(name) if isinstance(bus, NamingBus) else name


def open_bus(name: str, node: str, words: RosWords | None = None) -> Bus:
    """Open a bus by what a user types: ``zenoh``, or with an address behind a colon: ``zenoh:tcp/127.0.0.1:7447``.

    Args:
        name: Bus, with an address where it needs one: master (ros1), router (zenoh), domain (dds, ros2), file (bag).
        node: Name of this node, such as ``vlatool_vln``.
        words: What a launcher of ROS says of the node; with None, rospy and rclpy read the command line of the process.

    Raises:
        UsageError: for an unknown bus or an impossible address, and for words that are not for this bus.
        MissingExtra: when its library is absent.
        BusError: when it cannot be reached.
    """
    kind, _, address = name.partition(":")
    entry = load("buses", kind)
    if words is None:
        opened: Bus = entry(address, node)
    else:
        refuse_words_of_another(kind, words)
        opened = entry(address, node, words)
    return opened


def refuse_words_of_another(kind: str, words: RosWords) -> None:
    """Raise UsageError where the words of a launcher are not those of the ROS that a bus belongs to."""
    if words.dialect != kind:
        release = "ROS 1" if words.dialect == "ros1" else "ROS 2"
        raise UsageError(
            f"'{' '.join(words.typed):.80}' is for a node of {release}, and the bus is '{kind}'.",
            f"pass --bus {words.dialect}, or leave it out; --node NAME and --map NAME=/TOPIC work on every bus",
        )


def launch_parameters(name: str, node: str, words: RosWords) -> dict[str, Any]:
    """Return the parameters that a launcher gives a node: what ROS 1's master has for it, then those in its words.

    Args:
        name: Bus, as ``open_bus`` takes it; where it is empty, the words alone count.
        node: Name of the node without a launcher.
        words: What the launcher says of it.

    Raises:
        UsageError: as ``open_bus`` does.
        BusError: when the master does not answer.
        DataError: when a file or a value among the words is not YAML.
    """
    stored: Mapping[str, Any] = {}
    if name:
        kind, _, address = name.partition(":")
        refuse_words_of_another(kind, words)
        read = getattr(load("buses", kind), "stored_parameters", None)
        stored = {} if read is None else read(address, node, words)
    return {**stored, **words.parameters_for(node)}
