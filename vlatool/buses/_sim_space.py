"""What the nodes of one address of the bus ``sim`` share.

All of it is guarded by ``Space.changed``, which whoever calls a method holds unless the method says otherwise.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from vlatool.buses._goals import AwaitedGoal, Goals
from vlatool.buses._interface import ActionType, Reception, TopicInfo
from vlatool.messages import Message


class Member(Protocol):
    """A node on the address, as those see it that share it; compared by identity."""

    node: str

    def is_behind(self) -> bool:
        """Return whether messages wait for handlers of this node, or one is at work."""

    def record_fault(self, topic: str, error: Exception) -> None:
        """Count what a handler of a topic or service raised."""


class Subscription:
    """Messages of a topic that wait for a handler.

    Args:
        owner: Node that subscribes.
        topic: Name of the topic.
        ready: What that node has to deliver, in order: a subscription for each message that waits in it.
        handler: Called with each message.
        depth: How many messages wait; the oldest gives way.
    """

    def __init__(
        self, owner: Member, topic: str, ready: deque[Subscription], handler: Callable[[Reception], None], depth: int
    ) -> None:
        self.owner, self._topic, self._ready, self._handler = owner, topic, ready, handler
        self.waiting: deque[Reception] = deque(maxlen=max(1, depth))

    def put(self, reception: Reception) -> None:
        """Let a message wait."""
        if len(self.waiting) < (self.waiting.maxlen or 1):
            self._ready.append(self)
        self.waiting.append(reception)

    def handle(self, reception: Reception) -> None:
        """Call the handler, without the lock; what it raises is counted, and the next message comes nevertheless."""
        try:
            self._handler(reception)
        except Exception as error:
            self.owner.record_fault(self._topic, error)


class Topic:
    """A topic: who is at its ends, and its last message if that is latched."""

    def __init__(self, name: str, message: type[Message]) -> None:
        self.name, self.message = name, message
        self.publishers: list[Member] = []
        self.subscriptions: list[Subscription] = []
        self.latched: Message | None = None

    def is_used(self) -> bool:
        """Return whether anybody is at either end."""
        return bool(self.publishers or self.subscriptions)

    def info(self) -> TopicInfo:
        """Return what ``Bus.topics`` says of it."""
        readers = tuple(each.owner.node for each in self.subscriptions)
        return TopicInfo(self.name, (self.message.TYPE,), tuple(bus.node for bus in self.publishers), readers)


class Served:
    """A service of an address."""

    def __init__(
        self,
        owner: Member,
        name: str,
        request: type[Message],
        response: type[Message],
        handler: Callable[[Any], Message],
    ) -> None:
        self.owner, self.request, self.response = owner, request, response
        self._name, self._handler = name, handler

    def ask(self, request: Message, timeout_s: float) -> Message | Exception | None:
        """Return the answer, what the handler raised, or None when neither comes in time; called without the lock."""
        answers: list[Message | Exception] = []

        def answer() -> None:
            try:
                answers.append(self._handler(request))
            except Exception as error:
                self.owner.record_fault(self._name, error)
                answers.append(error)

        thread = threading.Thread(target=answer, name="sim service", daemon=True)
        thread.start()
        thread.join(timeout_s)
        return answers[0] if answers else None


class ServedAction(NamedTuple):
    """An action of an address."""

    owner: Member
    kind: ActionType
    goals: Goals


class LocalGoal(AwaitedGoal):
    """A goal that a node of this process sent; see ``ClientGoal``."""

    def __init__(self, action: str, goals: Goals) -> None:
        super().__init__(action)
        self.identifier = uuid.uuid4().hex
        self._goals = goals

    def cancel(self) -> None:
        """See ``ClientGoal.cancel``."""
        self._goals.cancel(self.identifier)


class Space:
    """Everything on one address."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.changed = threading.Condition()
        self.nodes: list[Member] = []
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Served] = {}
        self.actions: dict[str, ServedAction] = {}
        self.clock_s: float | None = None

    def now_s(self) -> float:
        """Return the simulated time, or that of ``time.monotonic`` where none is set, in seconds."""
        return time.monotonic() if self.clock_s is None else self.clock_s

    def leave(self, node: Member) -> None:
        """Take away all that a node has here; the last one leaves nothing behind, not even a latched message."""
        for topic in self.topics.values():
            topic.publishers = [each for each in topic.publishers if each is not node]
            topic.latched = topic.latched if topic.publishers else None
            topic.subscriptions = [each for each in topic.subscriptions if each.owner is not node]
        self.services = {name: each for name, each in self.services.items() if each.owner is not node}
        self.actions = {name: each for name, each in self.actions.items() if each.owner is not node}
        with _LOCK:
            self.nodes.remove(node)
            if not self.nodes:
                _SPACES.pop(self.address, None)


_LOCK = threading.Lock()
_SPACES: dict[str, Space] = {}


def join(address: str, node: Member) -> Space:
    """Return what the nodes of an address share, this one now among them; called without the lock."""
    with _LOCK:
        found = _SPACES.setdefault(address, Space(address))
        found.nodes.append(node)
    return found
