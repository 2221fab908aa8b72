"""What the buses with a graph of their own share: names of nodes and topics, actions, faults, peers, the end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vlatool.buses._faults import Faults
from vlatool.buses._graph import Graph
from vlatool.buses._interface import ActionBus, ActionType, Fault, Goal, Outcome, TopicInfo
from vlatool.buses._names import check_node, full_name, resolve
from vlatool.buses._service_actions import ServiceActionClient, ServiceActionServer, ServiceGoal
from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time


class GraphBus(ActionBus):
    """A part of a bus whose graph says who is there, and whose actions are services and topics, as in ROS 2.

    A subclass sets ``_graph``, and leaves the transport in ``_leave_transport``.

    Args:
        node: Name of this node.

    Raises:
        UsageError: for an impossible name.
    """

    _graph: Graph

    def __init__(self, node: str) -> None:
        self._node = check_node(node)
        self._faults = Faults()
        self._lock = threading.Lock()
        self._actions: list[ServiceActionServer] = []
        self._action_clients: dict[str, ServiceActionClient] = {}
        self._closing = self._closed = False

    def serve_action(self, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        """See ``ActionBus.serve_action``."""
        self._actions.append(ServiceActionServer(self, resolve(action, self._node), kind, handler))

    def send_goal(
        self, action: str, kind: ActionType, goal: Message, feedback: Callable[[Message], None] | None = None
    ) -> ServiceGoal:
        """See ``ActionBus.send_goal``."""
        name = resolve(action, self._node)
        if name not in self._action_clients:
            self._action_clients[name] = ServiceActionClient(self, name, kind)
        return self._action_clients[name].send(goal, feedback)

    def topics(self) -> list[TopicInfo]:
        """Return what is on the bus now, this node's own included, sorted by name."""
        self._discover()
        return self._graph.topics()

    def faults(self) -> list[Fault]:
        """Return what went wrong so far, one entry for each topic or service, sorted by name."""
        return self._faults.listing()

    def stamp(self) -> Time:
        """Return the time of day."""
        return Time(*divmod(time.time_ns(), 1_000_000_000))

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """Wait until each topic has a peer: a publisher, or a subscriber; return those without."""
        names = {topic: full_name(topic, self._node) for topic in topics}
        self._graph.wait(lambda: all(self._graph.has_peer(name) for name in names.values()), timeout_s)
        return tuple(topic for topic, name in names.items() if not self._graph.has_peer(name))

    def close(self) -> None:
        """Leave the bus; what is sent has left this process. Closing twice does nothing."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
        for action in self._actions:
            action.close()
        self._closed = True
        self._leave_transport()

    def _leave_transport(self) -> None:
        raise NotImplementedError

    def _discover(self) -> None:
        """Wait until the others can have been found, where that takes time."""

    def _check_open(self, topic: str) -> None:
        if self._closed:
            raise BusError(f"The bus of {topic} is closed.", "open it again")

    def _check(self, topic: str, message: type[Message]) -> str:
        """Return the full name of a topic that carries this type, or none yet."""
        name = full_name(topic, self._node)
        self._check_open(name)
        self._discover()
        self._graph.check_type(name, message.TYPE)
        return name
