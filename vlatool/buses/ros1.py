"""ROS 1, through rospy: the address is that of the master."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from vlatool.buses._faults import Faults
from vlatool.buses._interface import ActionType, Fault, Goal, M, Outcome, QoS, Reception, TopicInfo
from vlatool.buses._names import check_node, resolve
from vlatool.buses._ros1_master import Master, ask, master_uri, own_address
from vlatool.buses._ros_words import RosWords
from vlatool.buses._rospy_types import carrier, service_class
from vlatool.buses._topic_actions import TopicActionClient, TopicActionServer, TopicGoal
from vlatool.errors import BusError, MissingExtra, UsageError
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time

BUFFER_BYTES = 1 << 18
"""What is read from a connection at a time: a small camera image."""
FLUSH_S = 0.5
LEAVE_S = 1.0
"""Time in which whoever runs the node ends it, when it is asked to end: the robot is brought to rest meanwhile."""
LINGER_S = 0.02
"""Time that is left to the threads of rospy to write what they took from their queues, in seconds."""
WATCH_S = 0.25
CHECKS_OF_MASTER = 4
"""Every which look of the watching thread asks the master whether it still knows this node."""
RESTART = "start a new process: rospy has one node in each"
_used = threading.Lock()
"""Held from the first opening on."""


class Ros1:
    """A node of ROS 1; rospy allows one in a process, once.

    Args:
        address: The master, such as ``http://127.0.0.1:11311``; that of ``ROS_MASTER_URI`` when empty.
        node: Name of this node; roslaunch may give it another one (``__name:=``).
        words: What roslaunch says of the node; with None, rospy reads the command line of the process.
    """

    settle_s = 2.0
    """Time after which recorders hear a new topic, in seconds: ``rosbag record -a`` asks the master once a second."""

    def __init__(self, address: str, node: str, words: RosWords | None = None) -> None:
        check_node(words.name_for(node) if words else node)
        uri = _master_of(address, words)
        if words is not None and (namespace := words.namespace_for(node)):
            os.environ["ROS_NAMESPACE"] = namespace  # rospy reads it when it is imported
        rospy = _rospy()
        self._master = Master(uri, f"/{node}")
        self._master.ask("getPid")
        if not _used.acquire(blocking=False):
            raise BusError("A second node of ROS 1 was opened in this process.", RESTART)
        self._rospy: Any = rospy
        self._faults = Faults()
        self._actions: list[TopicActionServer] = []
        self._action_clients: dict[str, TopicActionClient] = {}
        self._asked, self._closed = threading.Event(), threading.Event()
        self._kinds: dict[str, type[Message]] = {}
        self._publishers: dict[str, Any] = {}
        self._subscribers: dict[str, Any] = {}
        self._start(uri, node, words)
        self._rospy.on_shutdown(self._leave)
        self._watcher = threading.Thread(target=self._watch, name="ros1 master", daemon=True)
        self._watcher.start()

    def _start(self, uri: str, node: str, words: RosWords | None) -> None:
        os.environ["ROS_MASTER_URI"] = uri
        if not {"ROS_IP", "ROS_HOSTNAME"} & {*os.environ} and (address := own_address(uri)):
            os.environ["ROS_IP"] = address
        renamed = words.name_for(node) if words else self._rospy.names.get_mappings().get("__name", node)
        arguments = None if words is None else [sys.argv[0], *words.for_library()]
        self._master.caller = f"{self._rospy.get_namespace()}{renamed.lstrip('/')}"
        try:
            self._master.refuse_namesake()
            self._rospy.init_node(node, arguments, disable_signals=True)
        except (self._rospy.ROSException, ValueError) as error:
            raise BusError(f"The node {node} cannot join the master at {uri}: {error}.", RESTART) from error
        except BusError:
            _used.release()  # rospy has not been started
            raise
        self.full_node = self._rospy.get_name().strip("/")
        self.node = self.full_node.rpartition("/")[2]

    @staticmethod
    def stored_parameters(address: str, node: str, words: RosWords) -> dict[str, Any]:
        """Return the parameters below the full name of a node at the master, as ``<param>`` in a launch file sets them.

        Raises:
            UsageError: for an impossible address.
            BusError: when no master answers.
        """
        full = words.full_name_for(node)
        values = Master(_master_of(address, words), full).ask("getParam", full)
        return values if isinstance(values, dict) else {}

    def resolve(self, name: str) -> str:
        """See ``NamingBus.resolve``."""
        return self._resolved(name)

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """See ``Bus.subscribe``; a latched message comes whatever ``qos`` says, as always in ROS 1."""
        name = self._agreed(topic, message)
        one_at_a_time = threading.Lock()

        def receive(got: Any) -> None:
            received_s = time.monotonic()
            if got.content is None:
                self._faults.add(name, _malformed(name, message))
                return
            try:
                with one_at_a_time:
                    handler(Reception(got.content, received_s))
            except Exception as error:  # rospy would print it, once for each message
                self._faults.add_raised(name, error)

        self._subscribers[name] = self._rospy.Subscriber(
            name, carrier(message), receive, queue_size=max(1, qos.depth), buff_size=BUFFER_BYTES, tcp_nodelay=True
        )

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """See ``Bus.publisher``."""
        name, kind = self._agreed(topic, message), carrier(message)
        publisher = self._rospy.Publisher(name, kind, latch=qos.latched, queue_size=max(1, qos.depth))
        self._publishers[name] = publisher

        def send(content: M) -> None:
            self._refuse_closed()
            try:
                publisher.publish(kind(content))
            except self._rospy.ROSException as error:
                raise BusError(f"{name} cannot be published: {error}.", RESTART) from error

        return send

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """See ``Bus.serve``; each call has a thread of its own."""
        name, kind = self._resolved(service), service_class(request, response)
        self._refuse_closed()
        self._master.refuse_second_server(name)

        def answer(got: Any) -> Any:
            if got.content is None:
                raise self._rospy.ServiceException(f"malformed {request.TYPE}")
            try:
                return kind._response_class(handler(got.content))
            except Exception as error:
                self._faults.add_raised(name, error)
                raise self._rospy.ServiceException(str(error)) from error

        self._rospy.Service(name, kind, answer)

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """See ``Bus.call``."""
        name, kind = self._resolved(service), service_class(type(request), response)
        self._refuse_closed()
        until = time.monotonic() + timeout_s
        while not self._master.ask("lookupService", name, timeout_s=max(0.1, until - time.monotonic())):
            if time.monotonic() > until:
                raise BusError(
                    f"Nobody has served {name} within {timeout_s:g} s.",
                    "start the node that serves it; rosservice list",
                )
            time.sleep(0.02)
        proxy, answers = self._rospy.ServiceProxy(name, kind), []

        def ask_it() -> None:
            try:
                answers.append(proxy(kind._request_class(request)))
            except Exception as error:
                answers.append(error)

        thread = threading.Thread(target=ask_it, name=f"ros1 call {name}", daemon=True)
        thread.start()
        thread.join(max(0.0, until - time.monotonic()))
        if not answers:
            proxy.close()
            raise BusError(f"The service {name} gave no answer within {timeout_s:g} s.", "call it again or wait longer")
        if isinstance(answers[0], Exception) or answers[0].content is None:
            why = answers[0] if isinstance(answers[0], Exception) else f"malformed {response.TYPE}"
            raise BusError(f"The service {name} failed: {why}.", "see what its node prints")
        found: M = answers[0].content
        return found

    def serve_action(self, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        """See ``ActionBus.serve_action``; the action is one of actionlib, whose topics are below its name."""
        self._actions.append(TopicActionServer(self, self._resolved(action), kind, handler))

    def send_goal(
        self, action: str, kind: ActionType, goal: Message, feedback: Callable[[Message], None] | None = None
    ) -> TopicGoal:
        """See ``ActionBus.send_goal``."""
        name = self._resolved(action)
        if name not in self._action_clients:
            self._action_clients[name] = TopicActionClient(self, self.node, name, kind)
        return self._action_clients[name].send(goal, feedback)

    def topics(self) -> list[TopicInfo]:
        """See ``Bus.topics``; of each topic the master knows one type, that of its last publisher.

        Raises:
            BusError: when the master does not answer, or the node was asked to end.
        """
        self._refuse_asked()
        return self._master.topics()

    def faults(self) -> list[Fault]:
        """See ``Bus.faults``."""
        return self._faults.listing()

    def stamp(self) -> Time:
        """Return ROS time: that of the system's clock, or that of ``/clock`` where ``/use_sim_time`` is set.

        Raises:
            BusError: when the node was asked to end, by ``rosnode kill`` or by another node of its name; it sends for
                another second, so that a controller's rest reaches the robot.
        """
        self._refuse_asked()
        now = self._rospy.Time.now()
        return Time(now.secs, now.nsecs)

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """See ``Bus.wait_for_peers``: a connection with each; of another topic, its registration."""
        until = time.monotonic() + timeout_s
        while (alone := tuple(topic for topic in topics if not self._has_peer(topic))) and time.monotonic() < until:
            time.sleep(0.01)
        return alone

    def close(self) -> None:
        """See ``Bus.close``; what waits is written within half a second, and the master forgets this node."""
        if self._closed.is_set():
            return
        for server in self._actions:
            server.close()
        self._closed.set()
        until = time.monotonic() + FLUSH_S
        while any(map(_is_waiting, self._publishers.values())) and time.monotonic() < until:
            time.sleep(0.005)
        time.sleep(LINGER_S if self._publishers else 0.0)
        end = threading.Thread(target=self._rospy.signal_shutdown, args=("closed",), name="ros1 end", daemon=True)
        end.start()
        end.join(5.0)

    def _resolved(self, topic: str) -> str:
        """Return the full name of a topic or service, with namespace and remappings of the command line."""
        resolve(topic, self.node)
        name: str = self._rospy.resolve_name(topic)
        return name

    def _agreed(self, topic: str, message: type[Message]) -> str:
        """Return the full name of a topic; raises BusError when it carries another type or no master answers."""
        self._refuse_closed()
        name = self._resolved(topic)
        own = self._kinds.get(name, message)
        if own is not message:
            raise BusError(
                f"The topic {name} carries {own.TYPE}, not {message.TYPE}.", "map one of both to another name"
            )
        self._master.refuse_other_type(name, message.TYPE)
        self._kinds[name] = message
        return name

    def _has_peer(self, topic: str) -> bool:
        name = self._resolved(topic)
        ends = [end for end in (self._subscribers.get(name), self._publishers.get(name)) if end is not None]
        if ends:
            return any(end.get_num_connections() for end in ends)
        return any(info.topic == name for info in self._master.topics())

    def _refuse_closed(self) -> None:
        if self._closed.is_set() or self._rospy.is_shutdown():
            raise BusError(f"The node {self.node} has left the bus: {self._why_over()}.", RESTART)

    def _refuse_asked(self) -> None:
        if self._asked.is_set() and not self._closed.is_set():
            raise BusError(f"The node {self.node} has left the bus: {self._why_over()}.", RESTART)

    def _why_over(self) -> str:
        if self._closed.is_set():
            return "it was closed"
        return "rosnode kill ended it, or another node of the same name took its place"

    def _leave(self) -> None:
        """Let whoever runs the node bring the robot to rest before rospy ends it."""
        self._asked.set()
        self._closed.wait(LEAVE_S)

    def _watch(self) -> None:
        """End the node when the main thread has, and register again at a master that was started anew."""
        looks = 0
        while not self._closed.wait(WATCH_S) and not self._rospy.is_shutdown():
            if not threading.main_thread().is_alive():
                self.close()  # threads of rospy would keep the process alive
                return
            looks += 1
            if looks % CHECKS_OF_MASTER == 0:
                with contextlib.suppress(BusError):
                    if not self._master.ask("lookupNode", self._master.caller, timeout_s=1.0):
                        self._register_again()

    def _register_again(self) -> None:
        registration = importlib.import_module("rospy.impl.registration")
        own, topics = self._rospy.get_node_uri(), registration.get_topic_manager()
        for name, kind in topics.get_publications():
            self._master.ask("registerPublisher", name, kind, own)
        for name, kind in topics.get_subscriptions():
            present = self._master.ask("registerSubscriber", name, kind, own)
            ask(own, "publisherUpdate", "/master", name, present or [])
        for name, uri in registration.get_service_manager().get_services():
            self._master.ask("registerService", name, uri, own)


def _master_of(address: str, words: RosWords | None) -> str:
    """Return the address of the master; raises UsageError where two are named."""
    named = words.special("master") if words else ""
    if address and named and master_uri(address) != master_uri(named):
        raise UsageError(f"Two masters are named: {address}, and {named} by '__master:='.", "name one of them")
    return master_uri(address or named)


def _malformed(name: str, message: type[Message]) -> BusError:
    return BusError(
        f"A message on {name} is malformed, although the MD5 sum is that of {message.TYPE}.", "see what its node sends"
    )


def _is_waiting(publisher: Any) -> bool:
    """Return whether messages wait in a queue of a publisher."""
    connections = getattr(getattr(publisher, "impl", None), "connections", None) or ()
    return any(getattr(connection, "_queue", None) for connection in connections)


def _rospy() -> Any:
    try:
        return importlib.import_module("rospy")
    except ImportError as error:
        missing = f"'{error.name}', which rospy needs, is" if error.name not in (None, "rospy") else "'rospy' is"
        raise MissingExtra(
            f"The bus 'ros1' needs ROS 1's Python client, and {missing} not installed.",
            "source /opt/ros/noetic/setup.bash, or on Debian: apt-get install python3-rospy; then use its Python",
        ) from error
