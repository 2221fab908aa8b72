"""ROS 2, through rclpy of an installed release: the address is the domain.

Not run against a real rclpy, which neither PyPI nor Debian has: the tests hold it against a double with rclpy's
documented interface. The buses ``dds`` and ``zenoh`` speak with ROS 2 nodes without rclpy.
"""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable
from typing import Any

from vlatool.buses._faults import Faults
from vlatool.buses._interface import ActionType, Fault, Goal, M, Outcome, QoS, Reception, TopicInfo
from vlatool.buses._names import check_node, domain_id, resolve
from vlatool.buses._rclpy_actions import ClientGoal, serve_action
from vlatool.buses._rclpy_messages import from_ros, generated_class, to_ros
from vlatool.buses._ros_words import RosWords
from vlatool.errors import BusError, MissingExtra
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time

DISCOVERY_S = 0.5
"""Time after which the other nodes of a domain are known, in seconds."""


class Ros2:
    """A node of ROS 2; rclpy's executor runs in a thread, and signals are left alone.

    Args:
        address: Number of the domain, 0 to 232; that of ``ROS_DOMAIN_ID`` when empty.
        node: Name of this node; a launch file may give it another one (``--ros-args -r __node:=``).
        words: What a launch file says of the node; with None, rclpy reads the command line of the process.
    """

    def __init__(self, address: str, node: str, words: RosWords | None = None) -> None:
        check_node(node)
        domain = domain_id(address)
        rclpy = _rclpy("rclpy")
        self._qos = _rclpy("rclpy.qos")
        self._faults = Faults()
        self._context = _rclpy("rclpy.context").Context()
        signals = _rclpy("rclpy.signals").SignalHandlerOptions.NO
        arguments = None if words is None else words.for_library()
        rclpy.init(args=arguments, context=self._context, domain_id=domain, signal_handler_options=signals)
        self._node = rclpy.create_node(node, context=self._context)
        self.node: str = self._node.get_name()
        self.full_node: str = self._node.get_fully_qualified_name().strip("/")
        self._executor = _rclpy("rclpy.executors").SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[str, Any] = {}
        self._subscriptions: dict[str, int] = {}
        self._clients: dict[tuple[str, str], Any] = {}
        self._ends: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._closed = False
        self._thread = threading.Thread(target=self._executor.spin, name=f"ros2 {node}", daemon=True)
        self._thread.start()
        time.sleep(DISCOVERY_S)

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """See ``Bus.subscribe``; other nodes are known half a second after this one has been opened."""
        name = self._agreed(topic, message)
        written = self._as_written(topic)

        def receive(theirs: Any) -> None:
            received_s = time.monotonic()
            try:
                handler(Reception(from_ros(message, theirs), received_s))
            except Exception as error:  # it would end the executor, and with it every other subscription
                self._faults.add_raised(name, error)

        self._node.create_subscription(generated_class(message.TYPE), written, receive, self._profile(qos))
        self._subscriptions[name] = self._subscriptions.get(name, 0) + 1

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """See ``Bus.publisher``."""
        name = self._agreed(topic, message)
        written = self._as_written(topic)
        publisher = self._node.create_publisher(generated_class(message.TYPE), written, self._profile(qos))
        self._publishers[name] = publisher

        def send(content: M) -> None:
            self._refuse_closed()
            if type(content) is not message:
                raise BusError(f"The topic {name} carries {message.TYPE}, not a {type(content).__name__}.", "send one")
            publisher.publish(to_ros(content))

        return send

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """See ``Bus.serve``; each call has a thread of its own, so that topics are heard meanwhile."""
        self._refuse_closed()
        name, kind = self.resolve(service), _service(request)

        async def answer(theirs: Any, empty: Any) -> Any:
            future = self._future()

            def work() -> None:
                try:
                    future.set_result(to_ros(handler(from_ros(request, theirs))))
                except Exception as error:  # the client gets an empty response
                    self._faults.add_raised(name, error)
                    future.set_result(empty)

            threading.Thread(target=work, name=f"ros2 {name}", daemon=True).start()
            return await future

        self._node.create_service(kind, self._as_written(service), answer)

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """See ``Bus.call``; a server that fails answers an empty response, as rclpy has no other way."""
        self._refuse_closed()
        name, until = self.resolve(service), time.monotonic() + timeout_s
        with self._lock:
            key = (name, request.TYPE)
            if key not in self._clients:
                self._clients[key] = self._node.create_client(_service(type(request)), self._as_written(service))
            client = self._clients[key]
        if not client.wait_for_service(timeout_sec=timeout_s):
            raise BusError(f"Nobody has served {name} within {timeout_s:g} s.", "start the node; ros2 service list")
        done = threading.Event()
        future = client.call_async(to_ros(request))
        future.add_done_callback(lambda _: done.set())
        if not done.wait(max(0.0, until - time.monotonic())):
            client.remove_pending_request(future)
            raise BusError(f"The service {name} gave no answer within {timeout_s:g} s.", "call it again or wait longer")
        if future.exception() is not None:
            raise BusError(f"The service {name} failed: {future.exception()}.", "see what its node prints")
        return from_ros(response, future.result())

    def serve_action(self, action: str, kind: ActionType, handler: Callable[[Goal], Outcome]) -> None:
        """See ``ActionBus.serve_action``; the action's generated class must be installed."""
        self._refuse_closed()
        self._ends.append(serve_action(self._node, self._as_written(action), kind, handler, self._future))

    def send_goal(
        self, action: str, kind: ActionType, goal: Message, feedback: Callable[[Message], None] | None = None
    ) -> ClientGoal:
        """See ``ActionBus.send_goal``."""
        self._refuse_closed()
        sent = ClientGoal(self._node, self._as_written(action), kind)
        sent.send(goal, feedback)
        return sent

    def resolve(self, name: str) -> str:
        """See ``NamingBus.resolve``."""
        full: str = self._node.resolve_topic_name(self._as_written(name))
        return full

    def _as_written(self, name: str) -> str:
        """Return a name as rclpy takes it, which writes ``~/`` for ``~``; raises UsageError for one that none takes."""
        resolve(name, self.node)
        return f"~/{name.lstrip('~/')}" if name.startswith("~") else name

    def topics(self) -> list[TopicInfo]:
        """See ``Bus.topics``."""
        self._refuse_closed()
        found = []
        for name, types in sorted(self._node.get_topic_names_and_types()):
            publishers = self._node.get_publishers_info_by_topic(name)
            subscribers = self._node.get_subscriptions_info_by_topic(name)
            found.append(
                TopicInfo(name, tuple(types), tuple(map(_full_name, publishers)), tuple(map(_full_name, subscribers)))
            )
        return found

    def faults(self) -> list[Fault]:
        """See ``Bus.faults``."""
        return self._faults.listing()

    def stamp(self) -> Time:
        """Return ROS time: that of the system's clock, or of ``/clock`` where ``use_sim_time`` is set."""
        now = self._node.get_clock().now().to_msg()
        return Time(now.sec, now.nanosec)

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """See ``Bus.wait_for_peers``."""
        until = time.monotonic() + timeout_s
        while (alone := tuple(topic for topic in topics if not self._has_peer(topic))) and time.monotonic() < until:
            time.sleep(0.02)
        return alone

    def close(self) -> None:
        """See ``Bus.close``."""
        if self._closed:
            return
        self._closed = True
        for end in self._ends:
            end()
        self._executor.shutdown(timeout_sec=1.0)
        if threading.current_thread() is not self._thread:
            self._thread.join(1.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _agreed(self, topic: str, message: type[Message]) -> str:
        """Return the full name of a topic; raises BusError when a node uses it with another type."""
        self._refuse_closed()
        name, written = self.resolve(topic), self._as_written(topic)  # rclpy applies remappings to the latter itself
        publishers = self._node.get_publishers_info_by_topic(written)
        for end in (*publishers, *self._node.get_subscriptions_info_by_topic(written)):
            if end.topic_type != message.TYPE:
                raise BusError(
                    f"The topic {name} carries {end.topic_type}, not {message.TYPE}; it is used by {_full_name(end)}.",
                    "map the topic to another name, or stop that node",
                )
        return name

    def _has_peer(self, topic: str) -> bool:
        name = self.resolve(topic)
        readers, writers = self._node.count_subscribers(name), self._node.count_publishers(name)
        if name in self._subscriptions or name in self._publishers:
            own_readers, own_writers = self._subscriptions.get(name, 0), int(name in self._publishers)
            return (own_readers > 0 and writers > own_writers) or (own_writers > 0 and readers > own_readers)
        return bool(readers or writers)

    def _profile(self, qos: QoS) -> Any:
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        return self._qos.QoSProfile(
            depth=max(1, qos.depth),
            reliability=reliability.RELIABLE if qos.reliable else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if qos.latched else durability.VOLATILE,
        )

    def _future(self) -> Any:
        """Return a future that wakes the executor when it is done, whichever thread does it."""
        future = _rclpy("rclpy.task").Future(executor=self._executor)
        future.add_done_callback(lambda _: None)  # which is queued in the executor, and that wakes it
        return future

    def _refuse_closed(self) -> None:
        if self._closed or not self._context.ok():
            raise BusError(f"The node {self.node} has left the bus.", "open the bus again")


def _service(request: type[Message]) -> Any:
    """Return the generated class of a service, by that of its requests."""
    return generated_class(request.TYPE.removesuffix("_Request"))


def _full_name(end: Any) -> str:
    """Return the full name of the node at an end of a topic."""
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def _rclpy(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtra(
            "The bus 'ros2' needs ROS 2's Python client, and 'rclpy' cannot be imported.",
            "source /opt/ros/$ROS_DISTRO/setup.bash and use that Python; without ROS 2, the buses zenoh and dds serve",
        ) from error
