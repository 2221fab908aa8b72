"""A bus inside one process: topics shared by an address, messages as objects, a simulated clock where one is set."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from vlatool.buses._faults import Faults
from vlatool.buses._goals import Goals
from vlatool.buses._interface import ActionType, Fault, Goal, M, Outcome, QoS, Reception, TopicInfo
from vlatool.buses._names import check_node, resolve
from vlatool.buses._sim_space import LocalGoal, Served, ServedAction, Subscription, Topic, join
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time


class Sim:
    """A node on an address of this process; whoever opens the same address meets it there.

    Messages are handed over as they are: an array in a message must not change once it is published.

    Args:
        address: Any text.
        node: Name of this node.
    """

    def __init__(self, address: str, node: str) -> None:
        self.node = check_node(node)
        self._ready: deque[Subscription] = deque()
        self.busy = self._closed = False
        """Whether a handler of this node is at work."""
        self._actions: list[Goals] = []
        self._faults = Faults()
        self._space = join(address, self)
        self._thread = threading.Thread(target=self._deliver, name=f"sim {node}", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """See ``Bus.subscribe``."""
        with self._space.changed:
            found = self._topic(topic, message)
            subscription = Subscription(self, found.name, self._ready, handler, qos.depth)
            found.subscriptions.append(subscription)
            if qos.latched and found.latched is not None:
                subscription.put(Reception(found.latched, self._space.now_s()))
            self._space.changed.notify_all()

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """See ``Bus.publisher``."""
        with self._space.changed:
            found = self._topic(topic, message)
            found.publishers.append(self)
            self._space.changed.notify_all()

        def send(content: M) -> None:
            if type(content) is not message:
                raise BusError(
                    f"The topic {found.name} carries {message.TYPE}, not a {type(content).__name__}.",
                    f"send a {message.__name__}",
                )
            with self._space.changed:
                self._refuse_closed()
                found.latched = content if qos.latched else found.latched
                for subscription in found.subscriptions:
                    subscription.put(Reception(content, self._space.now_s()))
                self._space.changed.notify_all()

        return send

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """See ``Bus.serve``; the handler is called in the thread of the caller's request, several at a time."""
        name = resolve(service, self.node)
        with self._space.changed:
            self._refuse_closed()
            if name in self._space.services:
                raise BusError(
                    f"The service {name} is served already, by {self._space.services[name].owner.node}.",
                    "stop that node, or give the service another name",
                )
            self._space.services[name] = Served(self, name, request, response, handler)
            self._space.changed.notify_all()

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """See ``Bus.call``."""
        name = resolve(service, self.node)
        with self._space.changed:
            self._space.changed.wait_for(lambda: name in self._space.services, timeout_s)
            served = self._space.services.get(name)
        if served is None:
            raise BusError(f"Nobody has served {name} within {timeout_s:g} s.", "start the node that serves it")
        if type(request) is not served.request or response is not served.response:
            raise BusError(
                f"The service {name} takes {served.request.TYPE}, not {type(request).TYPE}.", "send what it takes"
            )
        answer: Any = served.ask(request, timeout_s)
        if answer is None:
            raise BusError(
                f"The service {name} gave no answer within {timeout_s:g} s.", "call it again, or wait longer"
            )
        if isinstance(answer, Exception):
            raise BusError(f"The service {name} failed: {answer}.", "see what its node prints") from answer
        found: M = answer
        return found

    def serve_action(self, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        """See ``ActionBus.serve_action``."""
        name = resolve(action, self.node)
        with self._space.changed:
            self._refuse_closed()
            if name in self._space.actions:
                raise BusError(f"The action {name} is served already.", "stop the node that serves it")
            goals = Goals(f"sim {name}", kind.result, handler)
            self._actions.append(goals)
            self._space.actions[name] = ServedAction(self, kind, goals)

    def send_goal(
        self, action: str, kind: ActionType, goal: Message, feedback: Callable[[Message], None] | None = None
    ) -> LocalGoal:
        """See ``ActionBus.send_goal``."""
        name = resolve(action, self.node)
        with self._space.changed:
            self._refuse_closed()
            served = self._space.actions.get(name)
        if served is None:
            raise BusError(f"Nobody serves the action {name}.", "start the node that serves it")
        if served.kind != kind:
            raise BusError(f"The action {name} is a {served.kind.name}, not a {kind.name}.", "send what it takes")
        sent = LocalGoal(name, served.goals)
        served.goals.add(sent.identifier, goal, feedback or (lambda message: None), sent.finish)
        return sent

    def topics(self) -> list[TopicInfo]:
        """See ``Bus.topics``."""
        with self._space.changed:
            return [topic.info() for _, topic in sorted(self._space.topics.items()) if topic.is_used()]

    def faults(self) -> list[Fault]:
        """See ``Bus.faults``."""
        return self._faults.listing()

    def record_fault(self, topic: str, error: Exception) -> None:
        """Count what a handler of a topic or service raised."""
        self._faults.add_raised(topic, error)

    def stamp(self) -> Time:
        """Return the simulated time where one is set, else that of the system's clock."""
        with self._space.changed:
            clock = self._space.clock_s
        return Time(*divmod(time.time_ns(), 1_000_000_000)) if clock is None else Time.from_seconds(clock)

    def set_time(self, seconds: float) -> None:
        """Set the simulated clock of the address: from now on, it stamps messages and receptions.

        Args:
            seconds: Simulated time, which does not go back.
        """
        with self._space.changed:
            if self._space.clock_s is not None and seconds < self._space.clock_s:
                raise BusError(
                    f"The simulated clock shows {self._space.clock_s:g} s and cannot go back to {seconds:g} s.",
                    "open another address for another simulation",
                )
            self._space.clock_s = seconds

    def settle(self, timeout_s: float = 1.0) -> bool:
        """Wait until each message that was sent on the address is handled; return whether that is so in time."""
        with self._space.changed:
            return self._space.changed.wait_for(
                lambda: not any(node.is_behind() for node in self._space.nodes), timeout_s
            )

    def is_behind(self) -> bool:
        """Return whether messages wait for handlers of this node, or one is at work."""
        return self.busy or bool(self._ready)

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """See ``Bus.wait_for_peers``."""

        def without_peer() -> tuple[str, ...]:
            return tuple(name for name in topics if not self._has_peer(resolve(name, self.node)))

        with self._space.changed:
            self._space.changed.wait_for(lambda: not without_peer(), timeout_s)
            return without_peer()

    def close(self) -> None:
        """See ``Bus.close``."""
        with self._space.changed:
            if self._closed:
                return
            self._closed = True
            self._space.leave(self)
            self._ready.clear()
            self._space.changed.notify_all()
        for goals in self._actions:
            goals.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(1.0)

    def _topic(self, topic: str, message: type[Message]) -> Topic:
        """Return a topic of the address; raises BusError when it carries another type."""
        self._refuse_closed()
        name = resolve(topic, self.node)
        found = self._space.topics.get(name)
        if found is None or not (found.is_used() or found.message is message):
            found = self._space.topics[name] = Topic(name, message)
        if found.message is not message:
            raise BusError(
                f"The topic {name} carries {found.message.TYPE}, not {message.TYPE}.",
                "map the topic to another name, or stop the node that uses it otherwise",
            )
        return found

    def _has_peer(self, name: str) -> bool:
        """Return whether another node is at the other end of a topic; at either end if this one is at none."""
        topic = self._space.topics.get(name)
        if topic is None:
            return False
        readers = [each.owner for each in topic.subscriptions]
        ends = [other for own, other in ((readers, topic.publishers), (topic.publishers, readers)) if self in own]
        return any(bus is not self for end in ends or [readers, topic.publishers] for bus in end)

    def _refuse_closed(self) -> None:
        if self._closed:
            raise BusError(f"The node {self.node} has left the bus.", "open the bus again")

    def _deliver(self) -> None:
        changed = self._space.changed
        while True:
            with changed:
                self.busy = False
                changed.notify_all()
                changed.wait_for(lambda: self._ready or self._closed)
                if self._closed:
                    return
                subscription = self._ready.popleft()
                reception = subscription.waiting.popleft()
                self.busy = True
            subscription.handle(reception)
