"""Record the topics of a bus to a bag: those that are there, and those that appear meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from vlatool.buses import Bus, QoS, Reception, TopicInfo
from vlatool.errors import BusError, UsageError
from vlatool.messages import Message, find_type
from vlatool.nodes.step_record import CONTROLLER, STEPS

DEPTH = 100
LOOK_S = 0.1
"""Time between two looks at what topics there are, in seconds."""


@dataclass
class RecordSummary:
    """What was recorded.

    Args:
        messages: Topic -> messages.
        unknown: Topic -> why it was not recorded.
        seconds: How long.
    """

    messages: dict[str, int] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0


def _qos(topic: str) -> QoS:
    """Return what is asked of a topic: of a node's records all, of others what every publisher offers."""
    last = topic.rpartition("/")[2]
    return QoS(reliable=last in (STEPS, CONTROLLER), depth=DEPTH, latched=last == CONTROLLER)


class BusRecorder:
    """Records a bus.

    Args:
        bus: What is recorded.
        bag: Where to: a bus ``bag`` with a new bag.
        node: Name of the node that ``bus`` was opened for.
        topics: What is recorded; all topics when empty.
    """

    def __init__(self, bus: Bus, bag: Bus, node: str, topics: Sequence[str] = ()) -> None:
        self.summary = RecordSummary()
        self._bus, self._bag, self._node, self._wanted = bus, bag, node, frozenset(topics)
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._failure: BusError | None = None

    def stop(self) -> None:
        """Let ``run`` end; may be called from any thread."""
        self._stop.set()

    def run(self, seconds: float | None = None) -> RecordSummary:
        """Record until the time is over or ``stop`` is called.

        Raises:
            BusError: when a message cannot be written.
        """
        began = time.monotonic()
        try:
            while not self._stop.is_set() and self._failure is None:
                for info in self._bus.topics():
                    if info.topic not in self.summary.messages and info.topic not in self.summary.unknown:
                        self._add(info)
                left = LOOK_S if seconds is None else min(LOOK_S, began + seconds - time.monotonic())
                if left <= 0 or self._stop.wait(left):
                    break
        finally:
            self.summary.seconds = time.monotonic() - began
        for topic in sorted(self._wanted - {*self.summary.messages} - {*self.summary.unknown}):
            self.summary.unknown[topic] = "nobody published it"
        if self._failure is not None:
            raise self._failure
        return self.summary

    def _add(self, info: TopicInfo) -> None:
        """Record a topic from now on, if it is wanted and another node publishes it."""
        if (self._wanted and info.topic not in self._wanted) or not set(info.publishers) - {self._node}:
            return
        try:
            kind = find_type(info.types[0])
            self._bus.subscribe(info.topic, kind, self._writing(info.topic, kind), _qos(info.topic))
        except (UsageError, BusError) as error:
            self.summary.unknown[info.topic] = error.message.partition(";")[0]
        else:
            self.summary.messages.setdefault(info.topic, 0)

    def _writing(self, topic: str, kind: type[Message]) -> Callable[[Reception], None]:
        write = self._bag.publisher(topic, kind, QoS())

        def handle(got: Reception) -> None:
            try:
                write(got.message)
            except BusError as error:
                self._failure = error
                self._stop.set()
                return
            with self._lock:
                self.summary.messages[topic] = self.summary.messages.get(topic, 0) + 1

        return handle
