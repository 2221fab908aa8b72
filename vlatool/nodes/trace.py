"""What a report of a run draws: times, path, speeds, status and level of each step, without the messages themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from vlatool.buses import Bus, QoS, Reception
from vlatool.controllers import Snapshot
from vlatool.files.printable import truncate
from vlatool.messages import Message
from vlatool.messages.geometry_msgs import PoseStamped, Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.std_msgs import String
from vlatool.nodes.stepper import StepReport

MAX_POINTS = 20_000
"""Steps that are kept; of a longer run every second one, then every fourth, and so on."""
MAX_CHANGES = 10_000
"""Changes of a level that are kept; the oldest half gives way."""
MAX_TEXT, MAX_WORD = 300, 80
"""Characters of a status or a note, and of a level, that are kept: both may come from other nodes."""


class TracePoint(NamedTuple):
    """One step.

    Args:
        time_s: Time since the first step, in seconds.
        position: x and y of the newest odometry or pose, in metres; None without one.
        speeds: Linear speed in m/s and turn in rad/s that were commanded; None without a Twist.
        status: ``Command.status``.
        notes: ``Command.notes``.
        late_ms, compute_ms, total_ms: Times of the step, in milliseconds.
        ages_ms: Input -> age of its newest message, in milliseconds.
        skipped: Steps that were left out before it.
    """

    time_s: float
    position: tuple[float, float] | None
    speeds: tuple[float, float] | None
    status: str
    notes: Mapping[str, float | str]
    late_ms: float
    compute_ms: float
    total_ms: float
    ages_ms: Mapping[str, float]
    skipped: int


class Trace:
    """Collects the points of a run; an observer of it."""

    def __init__(self) -> None:
        self.points: list[TracePoint] = []
        self.steps = 0
        """Steps that were seen."""
        self.levels: dict[str, list[tuple[float, str]]] = {}
        """Topic -> time and text of what another node said of its level."""
        self._every = 1
        self.first_s = 0.0
        """Time of the first step."""

    def __call__(self, report: StepReport) -> None:
        """Take a step."""
        if not self.steps:
            self.first_s = report.snapshot.time_s
        if self.steps % self._every == 0:
            self.points.append(_point(report, self.first_s))
            if len(self.points) > MAX_POINTS:
                self.points, self._every = self.points[::2], 2 * self._every
        self.steps += 1


def watch_levels(bus: Bus, trace: Trace) -> None:
    """Keep what other nodes say of their levels: topics of texts that end in ``/level``, such as a safety monitor's."""

    def watching(topic: str) -> Callable[[Reception], None]:
        heard = trace.levels.setdefault(topic, [])

        def hear(got: Reception) -> None:
            text: Any = got.message
            word = truncate((text.data[: 2 * MAX_WORD].split() or [""])[0], MAX_WORD)
            if not heard or heard[-1][1] != word:
                del heard[: MAX_CHANGES // 2 if len(heard) == MAX_CHANGES else 0]
                heard.append((got.received_s, word))

        return hear

    for info in bus.topics():
        if info.topic.endswith("/level") and info.types == (String.TYPE,):
            bus.subscribe(info.topic, String, watching(info.topic), QoS())


def _point(report: StepReport, first_s: float) -> TracePoint:
    snapshot, command = report.snapshot, report.command
    sent = [message for messages in command.messages.values() for message in messages]
    ages = {name: (snapshot.time_s - got.received_s) * 1e3 for name, got in snapshot.newest.items()}
    notes = {name: truncate(value, MAX_TEXT) if isinstance(value, str) else value
             for name, value in command.notes.items()}  # fmt: skip
    return TracePoint(
        snapshot.time_s - first_s, _position(snapshot), _speeds(sent), truncate(command.status, MAX_TEXT), notes,
        report.late_s * 1e3, report.compute_s * 1e3, report.total_s * 1e3, ages, report.skipped,
    )  # fmt: skip


def _position(snapshot: Snapshot) -> tuple[float, float] | None:
    """Return where the robot is, by its newest odometry or pose with finite numbers."""
    for reading in snapshot.newest.values():
        message = reading.message
        pose = message.pose.pose if isinstance(message, Odometry) else getattr(message, "pose", None)
        if isinstance(message, Odometry | PoseStamped) and pose is not None:
            x, y = pose.position.x, pose.position.y
            if math.isfinite(x) and math.isfinite(y):
                return x, y
    return None


def _speeds(sent: list[Message]) -> tuple[float, float] | None:
    twist = next((message for message in sent if isinstance(message, Twist)), None)
    return None if twist is None else (math.hypot(twist.linear.x, twist.linear.y), twist.angular.z)


def phases(points: list[TracePoint], key: str = "", whole: bool = False) -> Iterator[tuple[float, float, str]]:
    """Return from when to when, in seconds, which word held: of the status, or of a note of this name.

    The word of a status is its first one, so that ``going 0.31`` and ``going 0.32`` are one phase; or the ``whole``.
    """
    began, word = 0.0, None
    for point in points:
        text = str(point.notes.get(key, "")) if key else point.status if whole else (point.status.split() or [""])[0]
        if text != word:
            if word is not None:
                yield began, point.time_s, word
            began, word = point.time_s, text
    if word is not None:
        yield began, points[-1].time_s, word
