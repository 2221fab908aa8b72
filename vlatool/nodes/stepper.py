"""One step of a controller: what waits in the inboxes becomes a snapshot, the controller answers with a command."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from vlatool.controllers import Command, RobotController, Snapshot
from vlatool.errors import BusError, UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.nodes.inbox import Calls, Inbox


class StepReport(NamedTuple):
    """What happened at a step.

    Args:
        number: Number of the step, from 0.
        snapshot: What the controller knew.
        command: What it wanted.
        late_s: How much later than scheduled the step began, in seconds; 0 in a simulation.
        compute_s: Time that the controller took, in seconds.
        total_s: Time from the beginning of the step until its messages were sent, in seconds.
        skipped: Steps that were left out before this one, because the time for them had passed.
    """

    number: int
    snapshot: Snapshot
    command: Command
    late_s: float = 0.0
    compute_s: float = 0.0
    total_s: float = 0.0
    skipped: int = 0


class Stepper:
    """A controller with its state, its inboxes and the calls of its services.

    Args:
        controller: The controller; its policy is reset by ``start``.

    Raises:
        UsageError: when the rate is not a number above 0, or two inputs, outputs or services share a name.
    """

    def __init__(self, controller: RobotController[Any]) -> None:
        check_controller(controller)
        self.controller = controller
        self.inboxes = {each.name: Inbox(each.depth) for each in controller.inputs}
        self.calls = Calls()
        self.state: Any = controller.start()
        self.number = 0

    def snapshot(self, time_s: float, stamp: Time) -> Snapshot:
        """Return what the controller knows now, and empty the inboxes."""
        readings = {name: inbox.take() for name, inbox in self.inboxes.items()}
        newest = {name: inbox.newest for name, inbox in self.inboxes.items() if inbox.newest is not None}
        return Snapshot(time_s, stamp, readings, newest, self.calls.take())

    def step(self, snapshot: Snapshot) -> StepReport:
        """Return what the controller wants, and keep its state for the next step.

        Raises:
            Exception: whatever the controller raises; its state is then what it was.
        """
        began = time.perf_counter()
        command, self.state = self.controller.step(snapshot, self.state)
        report = StepReport(self.number, snapshot, command, compute_s=time.perf_counter() - began)
        self.number += 1
        return report


class End(NamedTuple):
    """One end of a topic: an input or an output of a controller."""

    name: str
    topic: str
    message: type[Message]


def ends_of(controller: RobotController[Any], topics: Mapping[str, str]) -> list[End]:
    """Return the inputs and outputs of a controller with their topics."""
    inputs = [End(entry.name, topics[entry.name], entry.message) for entry in controller.inputs]
    return [*inputs, *(End(output.name, topics[output.name], output.message) for output in controller.outputs)]


def check_controller(controller: RobotController[Any]) -> None:
    """Raise UsageError where a controller cannot be run: an impossible rate, or two of its topics share a name."""
    rate = controller.rate_hz
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate <= 10_000:
        raise UsageError(f"The controller's rate is {rate!r:.40}; allowed: above 0, to 10,000 Hz.",
                         "set rate_hz to the rate of the robot's control loop")  # fmt: skip
    for kind, entries in (("inputs", controller.inputs), ("outputs", controller.outputs),
                          ("services", controller.services)):  # fmt: skip
        names = [entry.name for entry in entries]
        if double := next((name for name in names if names.count(name) > 1), ""):
            raise UsageError(f"Two {kind} of the controller have the name '{double}'.", "give each a name of its own")


def topics_of(controller: RobotController[Any], renamed: Mapping[str, str]) -> dict[str, str]:
    """Return the topic or service of each input, output and service by its name.

    Args:
        renamed: Name of an input, output or service, or its topic, -> another topic.

    Raises:
        UsageError: for an unknown name, a topic that does not begin with a slash, an output that the controller would
            hear itself, or one topic for two of them.
    """
    known = {entry.name: entry.topic for entry in controller.inputs}
    known |= {output.name: output.topic for output in controller.outputs}
    known |= {each.name: each.service for each in controller.services}
    by_topic = {topic: [name for name in known if known[name] == topic] for topic in known.values()}
    found = dict(known)
    for name, topic in renamed.items():
        if name not in known and name not in by_topic:
            raise UsageError.unknown(f"The controller has no topic '{name}' to map", name, [*known, *by_topic])
        if not topic.startswith("/") or len(topic) < 2 or any(letter.isspace() for letter in topic):
            raise UsageError(f"'{name}' is mapped to '{topic}', which is not the name of a topic.",
                             "write it from its slash on: --map scan=/front/scan")  # fmt: skip
        for each in by_topic.get(name, [name]):
            found[each] = topic
    read = {found[entry.name]: entry.name for entry in controller.inputs}
    for output in controller.outputs:
        if (topic := found[output.name]) in read:
            raise UsageError(f"'{output.name}' is mapped to {topic}, which its input '{read[topic]}' reads: the "
                             "controller would hear itself.", "map it to a topic of its own")  # fmt: skip
    written = [found[output.name] for output in controller.outputs]
    if double := next((topic for topic in written if written.count(topic) > 1), ""):
        raise UsageError(f"Two outputs of the controller are mapped to {double}.", "map each to a topic of its own")
    return found


def check_command(command: Command, controller: RobotController[Any]) -> None:
    """Raise BusError where a command names an output that the controller does not have, or has another type."""
    outputs = {each.name: each for each in controller.outputs}
    for name, messages in command.messages.items():
        if name not in outputs:
            raise BusError(f"The controller sends on the output '{name}', which it does not have.",
                           f"its outputs are: {', '.join(outputs) or 'none'}")  # fmt: skip
        for message in messages:
            if type(message) is not outputs[name].message:
                raise BusError(
                    f"The controller sends {type(message).TYPE or type(message).__name__} on '{name}', which carries "
                    f"{outputs[name].message.TYPE}.", "send messages of the type that the output states",
                )  # fmt: skip
