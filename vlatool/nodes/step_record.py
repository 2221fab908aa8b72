"""Records of steps: which messages a controller saw at which time and what it answered, enough to compute it again.

A node publishes one as JSON (``std_msgs/msg/String``) after each step, so that a bag of any recorder holds it beside
the messages themselves, and once, latched, what runs: the name of the controller, its settings and its topics.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vlatool.controllers import Command
from vlatool.errors import DataError, VlatoolError
from vlatool.files.json import parse_json
from vlatool.files.printable import one_line
from vlatool.machine.version import VERSION
from vlatool.messages import Message
from vlatool.messages.std_msgs import String
from vlatool.nodes.content import digest, to_text
from vlatool.nodes.stepper import StepReport

STEPS, CONTROLLER = "steps", "controller"
"""Last part of the names of the two topics; the name of the node stands before it."""


@dataclass(frozen=True)
class StepRecord:
    """A step, with digests in the place of the messages that were read.

    Args:
        step: Number of the step, from 0.
        time_s: ``Snapshot.time_s``.
        stamp: Seconds and nanoseconds of ``Snapshot.stamp``.
        readings: Input -> received_s, sequence and digest of each message that came since the last step; a text
            (``std_msgs/msg/String``) is written out.
        requests: Service, number and text of each call.
        messages: Output -> texts of the messages that were sent.
        responses: Number of a call -> text of its response.
        status: ``Command.status``.
        notes: ``Command.notes``, those of finite numbers and of text.
        skipped: Steps that were left out before this one.
        late_ms: How late the step began.
        compute_ms: Time that the controller took.
        total_ms: Time until its messages were sent.
    """

    step: int
    time_s: float
    stamp: tuple[int, int]
    readings: Mapping[str, tuple[tuple[float, int, str], ...]] = field(default_factory=dict)
    requests: tuple[tuple[str, int, str], ...] = ()
    messages: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    responses: Mapping[str, str] = field(default_factory=dict)
    status: str = ""
    notes: Mapping[str, float | str] = field(default_factory=dict)
    skipped: int = 0
    late_ms: float = 0.0
    compute_ms: float = 0.0
    total_ms: float = 0.0

    @classmethod
    def of(cls, report: StepReport) -> StepRecord:
        """Return the record of a step."""
        snapshot, command = report.snapshot, report.command
        return cls(
            report.number,
            snapshot.time_s,
            (snapshot.stamp.sec, snapshot.stamp.nanosec),
            {name: tuple((got.received_s, got.sequence, _content(got.message)) for got in readings)
             for name, readings in snapshot.readings.items() if readings},
            tuple((request.service, request.number, to_text(request.message)) for request in snapshot.requests),
            {name: tuple(map(to_text, messages)) for name, messages in command.messages.items()},
            {str(number): to_text(response) for number, response in command.responses.items()},
            command.status,
            dict(command.notes),
            report.skipped,
            *(round(seconds * 1e3, 4) for seconds in (report.late_s, report.compute_s, report.total_s)),
        )  # fmt: skip

    def to_json(self) -> str:
        """Return it as one line of JSON; what equals its default is left out, NaN stays NaN."""
        return json.dumps({key: value for key, value in vars(self).items() if value or key in ("step", "time_s")},
                          separators=(",", ":"))  # fmt: skip

    @classmethod
    def from_json(cls, text: str) -> StepRecord:
        """Return what ``to_json`` wrote; raises DataError for anything else."""
        try:
            values = json.loads(text)
            if not isinstance(values, dict) or type(values.get("step")) is not int:
                raise ValueError("another object")
            _refuse_newer(cls, values)
            return cls(
                values["step"], float(values["time_s"]), _pair(values.get("stamp", (0, 0))),
                {str(name): tuple((float(at), int(number), str(content)) for at, number, content in each)
                 for name, each in values.get("readings", {}).items()},
                tuple((str(name), int(number), str(content)) for name, number, content in values.get("requests", ())),
                {str(name): tuple(map(str, each)) for name, each in values.get("messages", {}).items()},
                {str(number): str(each) for number, each in values.get("responses", {}).items()},
                str(values.get("status", "")), dict(values.get("notes", {})), int(values.get("skipped", 0)),
                *(float(values.get(name, 0.0)) for name in ("late_ms", "compute_ms", "total_ms")),
            )  # fmt: skip
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            raise DataError(f"A record of a step is '{text:.60}', which cannot be read.", "record again") from None


def _content(message: Message) -> str:
    """Return a digest; a text is written out, since one that was latched came before any recorder."""
    return to_text(message) if isinstance(message, String) else digest(message)


def _pair(values: Any) -> tuple[int, int]:
    seconds, nanoseconds = values
    return int(seconds), int(nanoseconds)


@dataclass(frozen=True)
class ControllerRecord:
    """What runs.

    Args:
        controller: Name of the controller, such as ``vln``.
        settings: Its settings, as in a JSON file.
        topics: Input, output or service -> topic.
        node: Name of the node.
        policy: Identity of the bundle; empty without one.
        robot: Robot whose limits are kept; empty for none.
        version: Version of vlatool.
    """

    controller: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=dict)
    node: str = ""
    policy: str = ""
    robot: str = ""
    version: str = ""

    def to_json(self) -> str:
        """Return it as one line of JSON."""
        return json.dumps(vars(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> ControllerRecord:
        """Return what ``to_json`` wrote; raises DataError for anything else."""
        unreadable = DataError(f"The record of a controller is '{text:.60}', which cannot be read.", "record again")
        try:
            values = parse_json(text.encode())
        except (ValueError, VlatoolError):
            raise unreadable from None
        _refuse_newer(cls, values)
        try:
            record = cls(**values)
            if not all(isinstance(getattr(record, name), str) for name in ("controller", "node", "policy", "robot")):
                raise ValueError("a name that is none")
            return dataclasses.replace(record, settings=dict(record.settings), topics=dict(record.topics))
        except (ValueError, TypeError):
            raise unreadable from None


def _refuse_newer(cls: type, values: Any) -> None:
    """Raise DataError where an object has a field that its record does not have in this version."""
    known = {each.name for each in dataclasses.fields(cls)}
    if isinstance(values, dict) and (others := sorted(set(map(str, values)) - known)):
        writer = one_line(str(values.get("version") or "a newer one"), 40)
        raise DataError(
            f"A record of a run has '{one_line(others[0], 40)}', which vlatool {VERSION} does not know: {writer} wrote "
            "it.", "replay it with that version",
        )  # fmt: skip


def topic_of(node: str, part: str) -> str:
    """Return the topic of a node's records: ``/vlatool_vln/steps``."""
    return f"/{node.strip('/')}/{part}"


def differences(record: StepRecord, command: Command) -> list[tuple[str, int, str, str]]:
    """Return where a computed command differs from a recorded step: output, index, recorded text, computed text.

    Answers of services and the status are compared behind the messages.
    """
    recorded = {**record.messages, **{f"response {number}": (text,) for number, text in record.responses.items()}}
    computed = {name: tuple(map(to_text, messages)) for name, messages in command.messages.items()}
    computed |= {f"response {number}": (to_text(response),) for number, response in command.responses.items()}
    found = []
    for name in sorted({*recorded, *computed}, key=lambda name: (name not in command.messages, name)):
        old, new = recorded.get(name, ()), computed.get(name, ())
        for index in range(max(len(old), len(new))):
            one = old[index] if index < len(old) else ""
            other = new[index] if index < len(new) else ""
            if one != other:
                found.append((name, index, one, other))
    if record.status != command.status:
        found.append(("status of the step", 0, record.status, command.status))
    return found
