"""Controllers in a simulated world: one clock for all, no thread, as fast as the processor allows.

The same world, controllers and seed give the same messages, bit for bit. Several controllers form a chain: what one
sends on a topic is what another one reads there, and the world obeys what is left.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from vlatool.controllers import RobotController
from vlatool.errors import UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.nodes.content import digest
from vlatool.nodes.stepper import Stepper, StepReport, check_command, ends_of, topics_of
from vlatool.worlds import World

Truth = Mapping[str, Any]


class Node(NamedTuple):
    """A controller in a world.

    Args:
        controller: The controller, its policy set.
        topics: Other topics than its own: name of an input, output or service, or its topic -> topic.
        delay_s: Time from a step until its messages are sent, in simulated seconds: what the computation takes.
    """

    controller: RobotController[Any]
    topics: Mapping[str, str] = {}
    delay_s: float = 0.0


class Event(NamedTuple):
    """What somebody else sends in the course of a simulation.

    Args:
        time_s: When, in simulated seconds.
        topic: Topic of the message, or service that is called.
        message: The message, or the request.
        call: Whether it is a call of a service.
    """

    time_s: float
    topic: str
    message: Message
    call: bool = False


@dataclass
class WorldRun:
    """What happened in a world.

    Args:
        seconds: Simulated time.
        steps: Reports of the steps, those of each controller in a list of its own.
        truths: What the world says of itself, at the first step and after each step of the last controller.
        checksum: Of all messages that controllers sent, with topics and times: equal for equal runs.
    """

    seconds: float = 0.0
    steps: list[list[StepReport]] = field(default_factory=list)
    truths: list[tuple[float, Truth]] = field(default_factory=list)
    checksum: int = 0


class Simulation:
    """A world and the controllers in it, in their start states.

    Args:
        world: The robot; it is reset.
        nodes: Controllers, in the order in which they step when several are due at one time.
        seed: Seed of the world.
        obeys: Topic of a command of the world -> topic of which it takes it, such as ``/cmd_vel`` -> ``/safe_cmd_vel``.
        events: What others send, in any order.
        observers: Called with the number of the node and the report of each step.

    Raises:
        UsageError: when a controller is impossible, or a topic has two types.
    """

    def __init__(
        self,
        world: World,
        nodes: Sequence[Node | RobotController[Any]],
        *,
        seed: int = 0,
        obeys: Mapping[str, str] | None = None,
        events: Sequence[Event] = (),
        observers: Sequence[Callable[[int, StepReport], None]] = (),
    ) -> None:
        self.world = world
        self.nodes = [each if isinstance(each, Node) else Node(each) for each in nodes]
        world.reset(seed)
        self.steppers = [Stepper(node.controller) for node in self.nodes]
        self.topics = [topics_of(node.controller, node.topics) for node in self.nodes]
        self.run = WorldRun(steps=[[] for _ in self.nodes])
        self.sent: list[tuple[float, str, Message]] = []
        """Messages that were sent and not yet delivered, with the time at which they are."""
        self._start_s = world.time_s
        self._due = [0] * len(self.nodes)
        self._events = sorted(events, key=lambda event: event.time_s)
        self._observers = tuple(observers)
        other = obeys or {}
        self._commands = {other.get(channel.topic, channel.topic): channel.topic for channel in world.commands}
        self._refuse_types()

    def _refuse_types(self) -> None:
        """Raise UsageError where two ends of a topic state different types."""
        stated: dict[str, type[Message]] = {channel.topic: channel.message for channel in self.world.sensors}
        stated |= {topic: next(channel.message for channel in self.world.commands if channel.topic == command)
                   for topic, command in self._commands.items()}  # fmt: skip
        for node, topics in zip(self.nodes, self.topics, strict=True):
            for name, topic, message in ends_of(node.controller, topics):
                if stated.setdefault(topic, message) is not message:
                    raise UsageError(
                        f"The topic {topic} carries {stated[topic].TYPE}; the controller's '{name}' is "
                        f"{message.TYPE}.", "map it to another topic",
                    )  # fmt: skip

    @property
    def time_s(self) -> float:
        """Simulated time since the reset, in seconds."""
        return self.world.time_s - self._start_s

    def advance(self) -> None:
        """Let the world go on until the next step of a controller or the next delivery, and do what is due then."""
        moment = self._next()
        if moment > self.time_s:
            self.world.advance(moment - self.time_s)
        now = moment
        for topic, message in self.world.reports():
            self._deliver(topic, message, now)
        while self._events and self._events[0].time_s <= now:
            self._happen(self._events.pop(0), now)
        self._flush(now)
        for index, node in enumerate(self.nodes):
            if self._time_of(index) <= now:
                self._step(index, node, now)
        self._flush(now)
        self.run.seconds = now

    def play(self, seconds: float, until: Callable[[Truth], bool] | None = None) -> WorldRun:
        """Go on for so many simulated seconds, or until the world says something true; return what happened so far."""
        if not self.run.truths:
            self.run.truths.append((self.time_s, dict(self.world.truth())))
        while self._next() < seconds:
            before = len(self.run.steps[-1])
            self.advance()
            if len(self.run.steps[-1]) == before:
                continue
            truth = dict(self.world.truth())
            self.run.truths.append((self.run.seconds, truth))
            if until is not None and until(truth):
                break
        return self.run

    def rest(self) -> None:
        """Send the rest of each controller, as at the end of a run."""
        for node, topics in zip(self.nodes, self.topics, strict=True):
            for name, messages in node.controller.rest().messages.items():
                for message in messages:
                    self._deliver(topics[name], message, self.run.seconds)

    def _time_of(self, index: int) -> float:
        return self._due[index] / self.nodes[index].controller.rate_hz

    def _next(self) -> float:
        steps = [self._time_of(index) for index in range(len(self.nodes))]
        return min([*steps, *(event.time_s for event in self._events[:1]), *(moment for moment, _, _ in self.sent)])

    def _step(self, index: int, node: Node, now: float) -> None:
        stepper = self.steppers[index]
        report = stepper.step(stepper.snapshot(now, Time.from_seconds(self.world.time_s)))
        check_command(report.command, node.controller)
        self._due[index] += 1
        for name, messages in report.command.messages.items():
            topic = self.topics[index][name]
            for message in messages:
                self.run.checksum = zlib.crc32(f"{topic} {now!r} {digest(message)}".encode(), self.run.checksum)
                self.sent.append((now + node.delay_s, topic, message))
        for number, response in report.command.responses.items():
            stepper.calls.answer(number, response)
        self.run.steps[index].append(report)
        for observer in self._observers:
            observer(index, report)
        self._flush(now)

    def _flush(self, now: float) -> None:
        """Deliver what was sent and has arrived, in the order of the times."""
        arrived = sorted((each for each in self.sent if each[0] <= now), key=lambda each: each[0])
        self.sent = [each for each in self.sent if each[0] > now]
        for _, topic, message in arrived:
            self._deliver(topic, message, now)

    def _deliver(self, topic: str, message: Message, now: float) -> None:
        for node, topics, stepper in zip(self.nodes, self.topics, self.steppers, strict=True):
            for entry in node.controller.inputs:
                if topics[entry.name] == topic and type(message) is entry.message:
                    stepper.inboxes[entry.name].put(message, now)
        if topic in self._commands:
            self.world.obey(self._commands[topic], message)

    def _happen(self, event: Event, now: float) -> None:
        if not event.call:
            self._deliver(event.topic, event.message, now)
            return
        for node, topics, stepper in zip(self.nodes, self.topics, self.steppers, strict=True):
            for service in node.controller.services:
                if topics[service.name] == event.topic:
                    stepper.calls.add(service.name, event.message)


def play(
    world: World,
    nodes: Sequence[Node | RobotController[Any]],
    *,
    seconds: float,
    seed: int = 0,
    until: Callable[[Truth], bool] | None = None,
    **options: Any,
) -> WorldRun:
    """Play one episode of controllers in a world, and send each controller's rest at its end.

    Args:
        seconds: Longest simulated time.
        seed: Seed of the world.
        until: Ends the episode when it returns true for what the world says of itself.
        options: Further arguments of ``Simulation``.
    """
    simulation = Simulation(world, nodes, seed=seed, **options)
    run = simulation.play(seconds, until)
    simulation.rest()
    return run
