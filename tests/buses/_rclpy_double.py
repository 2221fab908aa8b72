"""A recording double of rclpy, with its documented signatures: nodes of one domain in this process meet each other.

Messages are classes as rosidl generates them for Python (array.array for sequences of numbers, ndarray for fixed
arrays, bytes for ``byte``, setters that check), from the definitions that rosbags has: none of vlatool's own.
"""

from __future__ import annotations

import array
import enum
import inspect
import itertools
import queue
import time
import types
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

CODES = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip
SERVICES = {
    "std_srvs/srv/SetBool_Request": "bool data", "std_srvs/srv/SetBool_Response": "bool success\nstring message",
}  # fmt: skip
ACTIONS = {
    "vlatool_msgs/action/RunInstruction_Goal": "string instruction\nfloat64 timeout_s",
    "vlatool_msgs/action/RunInstruction_Result": "bool success\nstring message",
    "vlatool_msgs/action/RunInstruction_Feedback": "string status\nfloat64 elapsed_s",
}


def install(patch: pytest.MonkeyPatch) -> Graph:
    """Put the double in the place of rclpy and of the generated packages; return the graph of its nodes."""
    graph = Graph()
    for name, content in {**_rclpy(graph), **_packages()}.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        patch.setitem(__import__("sys").modules, name, module)
    return graph


def _rclpy(graph: Graph) -> dict[str, dict[str, Any]]:
    def init(
        *, args: Any = None, context: Any = None, domain_id: int | None = None, signal_handler_options: Any = None
    ) -> None:
        assert context is not None
        context.domain = domain_id or 0
        context.valid = True
        context.rules = _rules(args or [])
        graph.signals.append(signal_handler_options)

    def create_node(node_name: str, *, context: Any = None, namespace: str | None = None) -> Node:
        assert context.ok()
        return Node(graph, node_name, context)

    return {
        "rclpy": {"init": init, "create_node": create_node},
        "rclpy.context": {"Context": Context},
        "rclpy.signals": {"SignalHandlerOptions": SignalHandlerOptions},
        "rclpy.qos": {
            "QoSProfile": QoSProfile, "ReliabilityPolicy": ReliabilityPolicy, "DurabilityPolicy": DurabilityPolicy,
        },
        "rclpy.executors": {"SingleThreadedExecutor": SingleThreadedExecutor},
        "rclpy.task": {"Future": Future},
        "rclpy.action": {"ActionServer": ActionServer, "ActionClient": ActionClient, "CancelResponse": CancelResponse},
    }  # fmt: skip


def _rules(arguments: list[str]) -> dict[str, str]:
    """Return the rules ``FROM:=TO`` behind ``--ros-args``, as rcl keeps them for a context."""
    return dict(word.split(":=") for flag, word in itertools.pairwise(arguments) if flag in ("-r", "--remap"))


def _packages() -> dict[str, dict[str, Any]]:
    """Return the modules of generated messages: ``geometry_msgs.msg`` -> its classes."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    fields = {name: entry[1] for name, entry in store.fielddefs.items()}
    for name, text in {**SERVICES, **ACTIONS}.items():
        ((_, fields[name]),) = get_types_from_msg(text, name).values()
    found: dict[str, dict[str, Any]] = {}
    classes: dict[str, type] = {}
    for name in fields:
        package, kind, short = name.split("/")
        classes[name] = type(short, (Generated,), {"NAME": name, "FIELDS": fields[name], "CLASSES": classes})
        found.setdefault(package, {})
        module = found.setdefault(f"{package}.{kind}", {})
        if kind == "msg":
            module[short] = classes[name]
        else:
            top, _, part = short.partition("_")
            setattr(module.setdefault(top, type(top, (), {})), part, classes[name])
    return found


class Generated:
    """A message as rosidl generates it; setters check as they do with Python's assertions on."""

    NAME = ""
    FIELDS: tuple[Any, ...] = ()
    CLASSES: dict[str, type] = {}

    def __init__(self) -> None:
        for name, description in self.FIELDS:
            object.__setattr__(self, f"_{name}", self._default(description))

    def _default(self, description: Any) -> Any:
        kind, inner = description
        if kind is Nodetype.NAME:
            return self.CLASSES[inner]()
        if kind is Nodetype.BASE:
            base = inner[0]
            if base == "string":
                return ""
            return False if base == "bool" else 0.0 if base.startswith("float") else b"\0" if base == "byte" else 0
        (element, what), length = inner
        base = what[0] if element is Nodetype.BASE else ""
        if kind is Nodetype.ARRAY:
            return np.zeros(length, base) if base in CODES else [""] * length
        return array.array(CODES[base]) if base in CODES else []

    def __getattr__(self, name: str) -> Any:
        if name in dict(self.FIELDS):
            return object.__getattribute__(self, f"_{name}")
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")

    def __setattr__(self, name: str, value: Any) -> None:
        present = getattr(self, name)
        assert type(value) is type(present), f"The '{name}' field must be of type {type(present).__name__}"
        if isinstance(present, array.array):
            assert value.typecode == present.typecode
        if isinstance(present, np.ndarray):
            assert value.dtype == present.dtype
            assert value.size == present.size
        if isinstance(present, int) and not isinstance(present, bool):
            base = dict(self.FIELDS)[name][1][0]
            assert np.iinfo(base).min <= value <= np.iinfo(base).max, f"The '{name}' field must be a {base}"
        object.__setattr__(self, f"_{name}", value)


class SignalHandlerOptions(enum.Enum):
    """As in rclpy.signals."""

    NO = 0
    ALL = 3


class ReliabilityPolicy(enum.IntEnum):
    """As in rclpy.qos."""

    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(enum.IntEnum):
    """As in rclpy.qos."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class CancelResponse(enum.Enum):
    """As in rclpy.action."""

    REJECT = 1
    ACCEPT = 2


class QoSProfile:
    """As in rclpy.qos; history is KEEP_LAST where a depth is given."""

    def __init__(self, *, depth: int, reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> None:
        self.depth, self.reliability, self.durability = depth, reliability, durability


class Context:
    """As in rclpy.context."""

    def __init__(self) -> None:
        self.valid, self.domain = False, 0
        self.rules: dict[str, str] = {}

    def ok(self) -> bool:
        return self.valid

    def try_shutdown(self) -> None:
        self.valid = False


class Future:
    """As in rclpy.task: what awaits it is asked again when its executor wakes."""

    def __init__(self, *, executor: SingleThreadedExecutor | None = None) -> None:
        self._executor, self._done, self._result = executor, False, None
        self._failure: Exception | None = None
        self._callbacks: list[Callable[[Future], None]] = []

    def __await__(self) -> Any:
        while not self._done:
            yield
        return self._result

    def result(self) -> Any:
        return self._result

    def exception(self) -> Exception | None:
        return self._failure

    def set_result(self, result: Any) -> None:
        self._result, self._done = result, True
        for callback in self._callbacks:
            self._call(callback)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        if self._done:
            self._call(callback)
        else:
            self._callbacks.append(callback)

    def _call(self, callback: Callable[[Future], None]) -> None:
        if self._executor is None:
            callback(self)
        else:
            self._executor.create_task(callback, self)


class SingleThreadedExecutor:
    """As in rclpy.executors: one callback at a time; a coroutine that waits is asked again at each wake."""

    def __init__(self, *, context: Context | None = None) -> None:
        self._context = context
        self._queue: queue.Queue[Callable[[], Any] | None] = queue.Queue()
        self._waiting: list[tuple[Any, Future]] = []

    def add_node(self, node: Node) -> bool:
        node.executor = self
        return True

    def create_task(self, callback: Any, *arguments: Any) -> Future:
        done = Future()
        self._queue.put(lambda: self._start(callback, arguments, done))
        return done

    def _start(self, callback: Any, arguments: tuple[Any, ...], done: Future) -> None:
        if inspect.iscoroutinefunction(callback):
            self._waiting.append((callback(*arguments), done))
        else:
            done.set_result(callback(*arguments))

    def spin(self) -> None:
        while (work := self._queue.get()) is not None:
            work()
            for entry in tuple(self._waiting):
                try:
                    entry[0].send(None)
                except StopIteration as stop:
                    self._waiting.remove(entry)
                    entry[1].set_result(stop.value)
        for coroutine, _ in self._waiting:
            coroutine.close()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        self._queue.put(None)
        return True


class Endpoint:
    """A publisher or subscription, and what get_publishers_info_by_topic says of it."""

    def __init__(self, node: Node, topic: str, kind: Any, profile: QoSProfile, callback: Any = None) -> None:
        self.node, self.topic, self.kind, self.profile, self.callback = node, topic, kind, profile, callback
        self.node_name, self.node_namespace, self.topic_type = node.name, node.namespace, kind.NAME
        self.last: Any = None

    def publish(self, message: Any) -> None:
        """Send a message to the subscriptions of the domain whose quality of service it meets."""
        if not isinstance(message, self.kind):
            raise TypeError(f"Expected {self.kind}, got {type(message)}")
        self.last = message
        for end in self.node.graph.ends("subscriptions", self.node, self.topic):
            if end.kind is self.kind and end.profile.reliability >= self.profile.reliability:
                end.node.executor.create_task(end.callback, message)


class Client:
    """As in rclpy.client."""

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._node, self._kind, self._name = node, kind, name

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        until = time.monotonic() + (timeout_sec or 0.0)
        while self._name not in self._node.graph.services and time.monotonic() < until:
            time.sleep(0.005)
        return self._name in self._node.graph.services

    def call_async(self, request: Any) -> Future:
        assert isinstance(request, self._kind.Request)
        node, callback = self._node.graph.services[self._name]
        return node.executor.create_task(callback, request, self._kind.Response())

    def remove_pending_request(self, future: Future) -> None:
        pass


class Node:
    """As in rclpy.node."""

    def __init__(self, graph: Graph, name: str, context: Context) -> None:
        self.graph, self.context = graph, context
        self.name = context.rules.get("__node", name)
        self.namespace = context.rules.get("__ns", "/")
        self.executor: SingleThreadedExecutor = None  # type: ignore[assignment]
        graph.nodes.append(self)
        self.publishers: list[Endpoint] = []
        self.subscriptions: list[Endpoint] = []

    def get_name(self) -> str:
        return self.name

    def get_fully_qualified_name(self) -> str:
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        rules = {self._expanded(left): right for left, right in self.context.rules.items() if left[:2] != "__"}
        full = self._expanded(topic)
        return self._expanded(rules[full]) if full in rules else full

    def _expanded(self, name: str) -> str:
        if name.startswith("~/"):
            return f"{self.get_fully_qualified_name()}/{name[2:]}"
        return name if name.startswith("/") else f"{self.namespace.rstrip('/')}/{name}"

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: QoSProfile) -> Endpoint:
        self.publishers.append(Endpoint(self, self.resolve_topic_name(topic), msg_type, qos_profile))
        return self.publishers[-1]

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[[Any], None], qos_profile: QoSProfile, *, raw: bool = False
    ) -> Endpoint:
        topic = self.resolve_topic_name(topic)
        self.subscriptions.append(Endpoint(self, topic, msg_type, qos_profile, callback))
        if qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL:
            for end in self.graph.ends("publishers", self, topic):
                if end.last is not None and end.profile.durability is DurabilityPolicy.TRANSIENT_LOCAL:
                    self.executor.create_task(callback, end.last)
        return self.subscriptions[-1]

    def create_service(self, srv_type: Any, srv_name: str, callback: Any) -> None:
        assert srv_type.Request
        self.graph.services[self.resolve_topic_name(srv_name)] = (self, callback)

    def create_client(self, srv_type: Any, srv_name: str) -> Client:
        return Client(self, srv_type, self.resolve_topic_name(srv_name))

    def get_publishers_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[Endpoint]:
        return self.graph.ends("publishers", self, self.resolve_topic_name(topic_name))

    def get_subscriptions_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[Endpoint]:
        return self.graph.ends("subscriptions", self, self.resolve_topic_name(topic_name))

    def count_publishers(self, topic_name: str) -> int:
        return len(self.graph.ends("publishers", self, topic_name))  # "the queried topic name is not remapped"

    def count_subscribers(self, topic_name: str) -> int:
        return len(self.graph.ends("subscriptions", self, topic_name))

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        found: dict[str, set[str]] = {}
        for node in self.graph.nodes:
            for end in (*node.publishers, *node.subscriptions):
                found.setdefault(end.topic, set()).add(end.kind.NAME)
        return [(name, sorted(kinds)) for name, kinds in found.items()]

    def get_clock(self) -> Any:
        moment = types.SimpleNamespace(sec=12, nanosec=34)
        now = types.SimpleNamespace(to_msg=lambda: moment)
        return types.SimpleNamespace(now=lambda: now)

    def destroy_node(self) -> None:
        self.graph.nodes.remove(self)
        self.graph.services = {name: each for name, each in self.graph.services.items() if each[0] is not self}


class Graph:
    """Nodes, services and actions of this process."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.services: dict[str, tuple[Node, Any]] = {}
        self.actions: dict[str, ActionServer] = {}
        self.signals: list[Any] = []

    def ends(self, side: str, of: Node, topic: str) -> list[Endpoint]:
        """Return the ends of a topic in the domain of a node."""
        nodes = [node for node in self.nodes if node.context.domain == of.context.domain]
        return [end for node in nodes for end in getattr(node, side) if end.topic == topic]


class ServerGoalHandle:
    """As in rclpy.action.server, with the state machine of rcl_action."""

    def __init__(self, server: ActionServer, request: Any) -> None:
        self.request, self.status, self._server = request, 2, server
        self.goal_id = types.SimpleNamespace(uuid=np.frombuffer(uuid.uuid4().bytes, np.uint8))
        self.report: Any = None

    @property
    def is_cancel_requested(self) -> bool:
        return self.status == 3

    def publish_feedback(self, feedback: Any) -> None:
        assert isinstance(feedback, self._server.kind.Feedback)
        self._server.node.executor.create_task(self.report, types.SimpleNamespace(feedback=feedback))

    def succeed(self) -> None:
        self._end(4)

    def abort(self) -> None:
        self._end(6)

    def canceled(self) -> None:
        if self.status != 3:
            raise RuntimeError("goal_handle attempted invalid transition from state EXECUTING with event CANCELED")
        self._end(5)

    def _end(self, status: int) -> None:
        assert self.status in (2, 3)
        self.status = status


class ActionServer:
    """As in rclpy.action."""

    def __init__(
        self, node: Node, action_type: Any, action_name: str, execute_callback: Any, *, cancel_callback: Any
    ) -> None:
        self.node, self.kind, self.name = node, action_type, action_name
        self.execute, self.cancel = execute_callback, cancel_callback
        node.graph.actions[action_name] = self

    def destroy(self) -> None:
        self.node.graph.actions.pop(self.name)


class ActionClient:
    """As in rclpy.action."""

    def __init__(self, node: Node, action_type: Any, action_name: str) -> None:
        self._node, self._kind, self._name = node, action_type, action_name

    def wait_for_server(self, timeout_sec: float | None = None) -> bool:
        return self._name in self._node.graph.actions

    def send_goal_async(self, goal: Any, feedback_callback: Any = None, goal_uuid: Any = None) -> Future:
        assert isinstance(goal, self._kind.Goal)
        server, answered = self._node.graph.actions[self._name], Future()
        handle = ServerGoalHandle(server, goal)
        handle.report = feedback_callback

        async def run() -> Any:
            result = await server.execute(handle)
            return types.SimpleNamespace(status=handle.status, result=result)

        def cancel() -> None:
            if server.cancel(handle) is CancelResponse.ACCEPT:
                handle.status = 3

        finished = server.node.executor.create_task(run)
        answered.set_result(types.SimpleNamespace(
            accepted=True, get_result_async=lambda: finished,
            cancel_goal_async=lambda: server.node.executor.create_task(cancel),
        ))  # fmt: skip
        return answered
