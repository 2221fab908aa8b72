"""A controller on a bus: a step at each tick of a clock that does not drift, a rest whenever it ends.

Needs NumPy alone. Whatever ends the run (its time, ``stop``, Ctrl-C, SIGTERM, SIGHUP, a step or a bus that fails), the
controller's ``rest`` is sent last, once, with the signals held back meanwhile.
"""

from __future__ import annotations

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vlatool.buses import Bus, QoS, Reception, name_on
from vlatool.controllers import Command, RobotController, Service
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.nodes.inbox import Inbox
from vlatool.nodes.stepper import Stepper, StepReport, check_command, ends_of, topics_of

Observer = Callable[[StepReport], None]
COMMANDS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "trajectory_msgs/msg/JointTrajectory")
"""Types that command a robot: two publishers of one topic fight each other."""
MAX_SAMPLES = 100_000
"""Times of steps that a summary is made of: the last ones."""


@dataclass
class RunSummary:
    """What a run was.

    Args:
        steps: Steps that were made.
        skipped: Steps that were left out because the one before them took too long.
        seconds: Time from the first step to the end.
        late_ms: How much later than scheduled each of the last steps began.
        compute_ms: Time that the controller took at each of the last steps.
        overhead_ms: Time of each of the last steps without that: inboxes, checks, sending.
        overwritten: Input -> messages that came too fast for the controller.
        status: Status of the last step.
    """

    steps: int = 0
    skipped: int = 0
    seconds: float = 0.0
    late_ms: list[float] = field(default_factory=list)
    compute_ms: list[float] = field(default_factory=list)
    overhead_ms: list[float] = field(default_factory=list)
    overwritten: dict[str, int] = field(default_factory=dict)
    status: str = ""

    def add(self, report: StepReport) -> None:
        """Count a step."""
        self.steps += 1
        self.skipped += report.skipped
        self.status = report.command.status
        self.late_ms.append(report.late_s * 1e3)
        self.compute_ms.append(report.compute_s * 1e3)
        self.overhead_ms.append((report.total_s - report.compute_s) * 1e3)
        if len(self.late_ms) > 2 * MAX_SAMPLES:
            for samples in (self.late_ms, self.compute_ms, self.overhead_ms):
                del samples[:MAX_SAMPLES]


class Runner:
    """Runs one controller on one bus.

    Args:
        controller: The controller, its policy set.
        bus: The bus; whoever opened it closes it.
        topics: Other topics than those of the controller: name of an input, output or service, or its topic -> topic.
        observers: Called with the report of each step after its messages were sent; they must return soon. An observer
            that raises ends the run.
        alone: Refuse to start where another node publishes one of the outputs.

    Raises:
        UsageError: when the controller or the topics are impossible.
        BusError: when a topic carries another type, or has another publisher.
    """

    def __init__(
        self,
        controller: RobotController[Any],
        bus: Bus,
        *,
        topics: Mapping[str, str] | None = None,
        observers: Sequence[Observer] = (),
        alone: bool = True,
    ) -> None:
        self.controller, self.bus = controller, bus
        self.written_topics = topics_of(controller, topics or {})
        """Input, output or service -> topic, as it is asked for."""
        self.topics = {name: name_on(bus, topic) for name, topic in self.written_topics.items()}
        """Input, output or service -> topic, as the bus calls it: a launch file of ROS may remap it."""
        self.summary = RunSummary()
        self._observers, self._stop = tuple(observers), threading.Event()
        self._stepper, self._alone = Stepper(controller), alone
        self._refuse_conflicts()
        self._senders: dict[str, Callable[[Any], None]] = {}
        for output in controller.outputs:
            qos = QoS(output.reliable, 10 if output.reliable else 1, output.latched)
            self._senders[output.name] = bus.publisher(self.written_topics[output.name], output.message, qos)
        for entry in controller.inputs:
            qos = QoS(entry.reliable, max(1, entry.depth), entry.latched)
            bus.subscribe(
                self.written_topics[entry.name], entry.message, _filling(self._stepper.inboxes[entry.name]), qos
            )
        for service in controller.services:
            bus.serve(self.written_topics[service.name], service.request, service.response, self._answering(service))

    def _refuse_conflicts(self) -> None:
        """Raise BusError where a topic carries another type, or an output has a publisher already."""
        present = {info.topic: info for info in self.bus.topics()}
        for name, topic, message in ends_of(self.controller, self.topics):
            info = present.get(topic)
            if info is not None and info.types and message.TYPE not in info.types:
                raise BusError(
                    f"The topic {topic} carries {', '.join(info.types)}; the controller's '{name}' is "
                    f"{message.TYPE}.", f"map '{name}' to a topic of that type: --map {name}=/TOPIC",
                )  # fmt: skip
        for output in self.controller.outputs if self._alone else ():
            info = present.get(self.topics[output.name])
            if info is not None and info.publishers:
                raise BusError(
                    f"The topic {info.topic} has the publisher {', '.join(info.publishers)} already: two would command "
                    "one robot.", f"stop that node, or map the output: --map {output.name}=/TOPIC",
                )  # fmt: skip

    def _refuse_others(self) -> None:
        """Raise BusError where an output has a publisher beside this node's: one that was not seen when it began."""
        present = {info.topic: info for info in self.bus.topics()} if self._alone else {}
        for output in self.controller.outputs:
            info = present.get(self.topics[output.name])
            if info is not None and len(info.publishers) > 1:
                names = ", ".join(sorted(info.publishers))
                raise BusError(
                    f"The topic {info.topic} has the publishers {names}: two would command one robot.",
                    f"stop the other node, or map the output: --map {output.name}=/TOPIC",
                )

    def _answering(self, service: Service) -> Callable[[Message], Any]:
        return lambda request: self._stepper.calls.ask(service.name, request, service.answer_s)

    def missing(self, timeout_s: float) -> tuple[str, ...]:
        """Wait until each required input has a publisher; return the topics without one after this many seconds."""
        wanted = {self.written_topics[entry.name]: self.topics[entry.name] for entry in self.controller.inputs
                  if entry.required}  # fmt: skip
        alone = self.bus.wait_for_peers(tuple(wanted), timeout_s) if wanted else ()
        return tuple(wanted[topic] for topic in alone)

    def unheard_topics(self) -> tuple[str, ...]:
        """Return the topics of commands for a robot that nobody subscribes to now."""
        wanted = [self.topics[each.name] for each in self.controller.outputs if each.message.TYPE in COMMANDS]
        heard = {info.topic for info in self.bus.topics() if info.subscribers}
        return tuple(topic for topic in wanted if topic not in heard)

    def stop(self) -> None:
        """Let the run end after its current step; may be called from any thread."""
        self._stop.set()

    def run(self, seconds: float | None = None) -> RunSummary:
        """Step at the controller's rate until the time is over or ``stop`` is called; then send its rest.

        Raises:
            BusError: when an output has another publisher by now; nothing was sent then.
            Exception: what a step, the bus or an observer raised, after the rest was sent.
            SystemExit: with 143 at SIGTERM, 129 at SIGHUP, where nobody handles it; KeyboardInterrupt at Ctrl-C.
        """
        self._refuse_others()
        began = time.monotonic()
        try:
            with _ended_by_signals():
                self._loop(began, math.inf if seconds is None else seconds)
        finally:
            with _signals_held_back():
                self._rest()
            self.summary.seconds = time.monotonic() - began
            self.summary.overwritten = {name: box.overwritten for name, box in self._stepper.inboxes.items()}
        return self.summary

    def _loop(self, began: float, seconds: float) -> None:
        """Step at ``began + k / rate``: a step that is late moves no later one, those it ran into are left out."""
        rate = self.controller.rate_hz
        tick = last = 0
        while tick / rate < seconds:
            scheduled = began + tick / rate
            if self._stop.wait(max(0.0, scheduled - time.monotonic())):
                return
            self._tick(scheduled, skipped=max(0, tick - last - 1))
            last = tick
            tick = max(tick + 1, math.ceil((time.monotonic() - began) * rate))
        if math.isfinite(seconds):
            self.summary.skipped += max(0, math.ceil(seconds * rate - 1e-9) - last - 1)

    def _tick(self, scheduled: float, skipped: int) -> None:
        now = time.monotonic()
        began = time.perf_counter()
        report = self._stepper.step(self._stepper.snapshot(now, self.bus.stamp()))
        check_command(report.command, self.controller)
        self._send(report.command)
        total = time.perf_counter() - began
        report = report._replace(late_s=now - scheduled, total_s=total, skipped=skipped)
        self.summary.add(report)
        for observer in self._observers:
            observer(report)

    def _send(self, command: Command) -> None:
        for name, messages in command.messages.items():
            send = self._senders[name]
            for message in messages:
                send(message)
        for number, response in command.responses.items():
            self._stepper.calls.answer(number, response)

    def _rest(self) -> None:
        """Send what stops the robot, on every output that still takes it; raise what kept it from all of them."""
        self._stepper.calls.end()
        command, failure, sent = self.controller.rest(), None, 0
        for name, messages in command.messages.items():
            for message in messages:
                try:
                    self._senders[name](message)
                    sent += 1
                except Exception as error:  # another output may still take its message
                    failure = error
        if failure is not None and not sent:
            raise failure


def _filling(inbox: Inbox) -> Callable[[Reception], None]:
    return lambda got: inbox.put(got.message, got.received_s)


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP, of a terminal that is gone, raise SystemExit where nobody handles them yet: the robot is
    brought to rest.
    """

    def end(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    mine = threading.current_thread() is threading.main_thread()
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if mine and hasattr(signal, name)]
    numbers = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


@contextlib.contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP wait until what is inside is done: a second Ctrl-C must not cut the rest short."""
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
