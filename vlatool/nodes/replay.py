"""A recorded run computed again: the same snapshots for the same controller, its commands beside the recorded ones."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from vlatool.controllers import Reading, Request, RobotController, Snapshot
from vlatool.errors import DataError
from vlatool.files.printable import amount
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.nodes.content import digest, digest_of, from_text
from vlatool.nodes.run_log import Item, LogEnd, Received
from vlatool.nodes.step_record import StepRecord, differences
from vlatool.nodes.stepper import check_controller

MAX_WAITING = 4096
"""Messages of an input that wait for the step that read them: a recorder writes the two in nearly the same order."""


@dataclass(frozen=True)
class Difference:
    """The first difference.

    Args:
        step: Number of the step.
        output: Output of the controller, ``response N`` to a call, or ``status of the step``.
        index: Which of its messages.
        recorded: The recorded message, as ``content.to_text`` writes it; empty for none.
        computed: The one that was computed again.
    """

    step: int
    output: str
    index: int
    recorded: str
    computed: str


@dataclass(frozen=True)
class ReplayReport:
    """What a replay found.

    Args:
        steps: Steps that were computed again.
        messages: Messages of commands that were compared.
        differing: Steps whose commands differ; after the first one, the state may differ, too.
        difference: The first difference; None where all commands are equal bit for bit.
        unused: Recorded messages that no step read.
        unheard: Commands in the records of the steps that are not among the recorded messages of their topics.
        note: Why the replay ends before the run did; empty where it does not.
        altered: Recorded commands in place of unheard ones: messages on their topics that no step sent.
    """

    steps: int
    messages: int
    differing: int
    difference: Difference | None
    unused: int
    note: str
    unheard: int = 0
    altered: int = 0

    @property
    def equal(self) -> bool:
        """Whether all commands are equal bit for bit, and none of them was recorded otherwise."""
        return self.difference is None and not self.altered

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return {**asdict(self), "equal": self.equal}


class _Messages:
    """Recorded messages by input and digest, until a step has read them."""

    def __init__(self, channels: Mapping[str, tuple[str, ...]]) -> None:
        self._inputs = channels
        self._waiting: dict[str, dict[str, list[Message]]] = {}
        self._order: dict[str, list[str]] = {}
        self.unused = 0
        self.heard: Counter[tuple[str, str]] = Counter()
        """How often each message came: (channel, digest) -> count."""

    def add(self, got: Received) -> None:
        self.heard[got.channel, got.digest] += 1
        for name in self._inputs.get(got.channel, ()):
            self._waiting.setdefault(name, {}).setdefault(got.digest, []).append(got.message)
            order = self._order.setdefault(name, [])
            order.append(got.digest)
            if len(order) > MAX_WAITING:
                self._forget(name, order.pop(0))

    def _forget(self, name: str, content: str) -> None:
        if left := self._waiting[name].get(content):
            left.pop(0)
            self.unused += 1
            if not left:
                del self._waiting[name][content]

    def has(self, record: StepRecord) -> str:
        """Return the first input of which a message is missing; empty where all are there."""
        for name, readings in record.readings.items():
            there = self._waiting.get(name, {})
            needed = [content for _, _, content in readings if "=" not in content]
            if any(len(there.get(content, ())) < needed.count(content) for content in set(needed)):
                return name
        return ""

    def take(self, record: StepRecord) -> dict[str, tuple[Reading, ...]]:
        found = {}
        for name, readings in record.readings.items():
            taken = []
            for received_s, sequence, content in readings:
                key = digest_of(content) if "=" in content else content
                left = self._waiting.get(name, {}).get(key, [])
                message = left.pop(0) if left else from_text(content)
                taken.append(Reading(message, received_s, sequence))
                if not left:
                    self._waiting.get(name, {}).pop(key, None)
            found[name] = tuple(taken)
        return found

    def unread(self) -> int:
        """Return how many messages no step has read."""
        return self.unused + sum(len(left) for there in self._waiting.values() for left in there.values())


def replay(controller: RobotController[Any], items: Iterable[Item], topics: Mapping[str, str] | None) -> ReplayReport:
    """Compute the steps of a recording again.

    Args:
        controller: The controller with the settings and the policy that ran, the policy without a deadline.
        items: The recording, from its first step on.
        topics: Input -> topic, where ``Received.channel`` is a topic; None where it is the input.

    Raises:
        DataError: when the recording holds no step, or begins after the first one.
    """
    check_controller(controller)
    names = [entry.name for entry in controller.inputs]
    channels: dict[str, tuple[str, ...]] = {}
    for name in names:
        channel = name if topics is None else topics.get(name)
        if channel is not None:  # a recording of another version may lack an input
            channels[channel] = (*channels.get(channel, ()), name)
    outputs = (
        {} if topics is None else {each.name: topics[each.name] for each in controller.outputs if each.name in topics}
    )
    return _Replay(controller, _Messages(channels), names, outputs).run(items)


class _Replay:
    def __init__(
        self, controller: RobotController[Any], messages: _Messages, inputs: list[str], outputs: Mapping[str, str]
    ) -> None:
        self._controller, self._messages, self._inputs, self._outputs = controller, messages, inputs, outputs
        self._sent: Counter[tuple[str, str]] = Counter()
        self._state: Any = controller.start()
        self._newest: dict[str, Reading] = {}
        self._waiting: list[StepRecord] = []
        self._steps = self._compared = self._differing = 0
        self._first: Difference | None = None

    def run(self, items: Iterable[Item]) -> ReplayReport:
        end = ""
        for item in items:
            if isinstance(item, Received):
                self._messages.add(item)
            elif isinstance(item, StepRecord):
                self._expect(item)
                self._waiting.append(item)
            elif isinstance(item, LogEnd):
                end = item.note
            note = self._work()
            if note:
                break
        else:
            note = self._missing() if self._waiting else end
        if not self._steps and note:
            raise DataError(
                f"No step can be computed again: {note}.", "record the topics that it reads from the start on"
            )
        if not self._steps:
            raise DataError("The recording holds no step of a controller.",
                            "record the topics /NODE/steps and /NODE/controller, too, or all topics")  # fmt: skip
        unheard = sum((self._sent - self._messages.heard).values())
        altered = 0 if note else min(unheard, self._foreign())
        return ReplayReport(self._steps, self._compared, self._differing, self._first, self._messages.unread(), note,
                            unheard, altered)  # fmt: skip

    def _foreign(self) -> int:
        """Return how many messages on the topics of its outputs are neither of a step nor of its rest."""
        rest = self._controller.rest().messages
        last = Counter((topic, digest(message)) for name, topic in self._outputs.items()
                       for message in rest.get(name, ()))  # fmt: skip
        topics = {*self._outputs.values()}
        strange = self._messages.heard - self._sent - last
        return sum(count for (topic, _), count in strange.items() if topic in topics)

    def _expect(self, record: StepRecord) -> None:
        if not self._steps and not self._waiting and record.step:
            raise DataError(f"The recording begins at step {record.step}; what the controller knew then is not in it.",
                            "start the recorder before the controller, or run it with --record")  # fmt: skip

    def _work(self) -> str:
        """Compute the steps whose messages are all there; return why it cannot go on, if so."""
        while self._waiting and not self._messages.has(self._waiting[0]):
            record = self._waiting.pop(0)
            if record.step < self._steps:
                return f"another run of the node begins, after step {self._steps - 1} of this one"
            if record.step != self._steps:
                return f"the records of the steps {self._steps} to {record.step - 1} are not in the recording"
            self._step(record)
        return self._missing() if len(self._waiting) > MAX_WAITING else ""

    def _missing(self) -> str:
        record = self._waiting[0]
        return f"a message of '{self._messages.has(record)}' that step {record.step} read is not in the recording"

    def _step(self, record: StepRecord) -> None:
        taken = self._messages.take(record)
        readings = {name: taken.get(name, ()) for name in self._inputs}
        self._newest.update({name: each[-1] for name, each in taken.items() if each})
        newest = {name: self._newest[name] for name in self._inputs if name in self._newest}
        requests = tuple(Request(name, from_text(text), number) for name, number, text in record.requests)
        snapshot = Snapshot(record.time_s, Time(*record.stamp), readings, newest, requests)
        command, self._state = self._controller.step(snapshot, self._state)
        self._steps += 1
        self._compared += sum(map(len, record.messages.values()))
        for name, topic in self._outputs.items():
            self._sent.update((topic, digest_of(text)) for text in record.messages.get(name, ()))
        found = differences(record, command)
        self._differing += bool(found)
        if found and self._first is None:
            self._first = Difference(record.step, *found[0])


def lines(report: ReplayReport) -> Iterator[str]:
    """Return what a person reads."""
    count = f"{report.steps} steps, {report.messages} messages of commands"
    if report.difference is None:
        yield f"{count}: bit-equal"
    else:
        first = report.difference
        yield f"{count}: {report.differing} steps differ, the first is {first.step}, '{first.output}'"
        yield f"  recorded  {_shown(first.recorded)}"
        yield f"  computed  {_shown(first.computed)}"
    if report.altered:
        yield f"{amount(report.altered, 'recorded command')} that no step sent: altered, or of another node"
    if report.unheard:
        yield f"{report.unheard} of them are not among the recorded messages of their topics"
    if report.note:
        yield f"the replay ends there: {report.note}"


def _shown(text: str) -> str:
    """Return a recorded text as a person reads it: the message that it is, or itself."""
    with contextlib.suppress(DataError):
        return str(from_text(text))
    return text or "nothing"
