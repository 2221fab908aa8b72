"""Zenoh in the way of rmw_zenoh: ROS 2 nodes that run with it and these nodes see and hear each other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from itertools import count
from typing import Any, TypeVar

from vlatool.buses._graph import CLIENT, PUBLISHER, SERVICE, SUBSCRIBER, Entity
from vlatool.buses._graph_bus import GraphBus
from vlatool.buses._inbox import Inbox
from vlatool.buses._interface import QoS, Reception
from vlatool.buses._names import domain_id, full_name
from vlatool.buses._zenoh_graph import ZenohGraph
from vlatool.buses._zenoh_keys import ATTACHMENT, attachment, data_key, entity_token, gid_of, node_token
from vlatool.buses._zenoh_session import open_session
from vlatool.errors import BusError, require
from vlatool.messages import Message
from vlatool.messages.cdr import decode, encode
from vlatool.messages.type_hash import rihs01, service_rihs01

M = TypeVar("M", bound=Message)
SERVICE_QOS = QoS(reliable=True, depth=10)
"""ROS 2's quality of service for services (rmw_qos_profile_services_default)."""
DISCOVERY_S = 0.25
"""How long the nodes that the router names may take to be connected, and with them what they publish; then it is
known who is on a topic."""
LOOK_S = 0.005
"""Time between two looks at whether a publisher has a way to its subscribers, in seconds."""
HEARTBEAT_S = 0.5
"""Period at which a latched publisher repeats the number of its last message, so that a lost one is asked for."""


class Zenoh(GraphBus):
    """A node on a Zenoh bus; the ROS domain is that of ``ROS_DOMAIN_ID``.

    Args:
        address: Endpoint of the router, such as ``tcp/127.0.0.1:7447``; behind ``router/``, the endpoint at which
            this node is the router; empty for ``tcp/localhost:7447``.
        node: Name of this node.

    Raises:
        UsageError: for an impossible address, domain or name.
        MissingExtra: when eclipse-zenoh is absent.
        BusError: when no router answers within three seconds.
    """

    def __init__(self, address: str, node: str) -> None:
        super().__init__(node)
        self._domain = domain_id()
        self._session = open_session(address)
        self._opened_s = time.monotonic()
        self._zenoh: Any = require("zenoh", "zenoh")
        self._advanced: Any = require("zenoh.ext", "zenoh")
        self._id = str(self._session.info.zid())
        self._numbers = count(1)
        self._declared: list[Any] = []
        self._inboxes: list[Inbox] = []
        self._publishers: dict[str, list[Any]] = {}
        self._clients: dict[str, bytes] = {}
        self._graph: ZenohGraph = ZenohGraph(self._zenoh, self._session, self._domain, self._faults)
        self._keep(self._session.liveliness().declare_token(node_token(self._domain, self._id, node)))

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """Call ``handler`` with each message of a topic, in a thread of the subscription.

        Raises:
            BusError: when the topic carries another type.
        """
        name, zenoh = self._check(topic, message), self._zenoh
        inbox = Inbox(name, message, handler, qos.depth, lambda payload: payload.to_bytes(), self._faults)
        hear = zenoh.handlers.Callback(lambda sample: inbox.put(sample.payload), indirect=False)
        key = self._key(name, message)
        if qos.latched:
            advanced = self._advanced
            history = advanced.HistoryConfig(detect_late_publishers=True, max_samples=max(1, qos.depth))
            recovery = advanced.RecoveryConfig(heartbeat=True)
            self._keep(
                advanced.declare_advanced_subscriber(self._session, key, hear, history=history, recovery=recovery)
            )
        else:
            self._keep(self._session.declare_subscriber(key, hear))
        with self._lock:
            self._inboxes.append(inbox)
        self._announce(SUBSCRIBER, name, message.TYPE, rihs01(message), qos)

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """Announce a topic and return what sends a message on it; it never blocks: what cannot be sent is dropped.

        Raises:
            BusError: when the topic carries another type.
        """
        name = self._check(topic, message)
        publisher = self._keep(self._declare_publisher(self._key(name, message), qos))
        self._publishers.setdefault(name, []).append(publisher)
        gid = self._announce(PUBLISHER, name, message.TYPE, rihs01(message), qos)
        sequence = count(1)

        def send(value: M) -> None:
            payload = encode(value)
            self._check_open(name)
            publisher.put(payload, attachment=attachment(next(sequence), time.time_ns(), gid))

        return send

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """Answer a service, each request in a thread of its own."""
        name = full_name(service, self._node)
        type_name, type_hash = _service_type(request, response)
        key = data_key(self._domain, name, type_name, type_hash)

        def answer(query: Any) -> None:
            with query:
                try:
                    value = handler(decode(request, query.payload.to_bytes() if query.payload else b""))
                    query.reply(key, encode(value), attachment=_answered(query.attachment))
                except Exception as error:  # a handler may raise anything; the bus goes on
                    self._faults.add_raised(name, error)
                    query.reply_err(str(error).encode())

        def hear(query: Any) -> None:
            threading.Thread(target=answer, args=(query,), name=f"vlatool {name}", daemon=True).start()

        self._keep(self._session.declare_queryable(key, hear, complete=True))
        self._announce(SERVICE, name, type_name, type_hash, SERVICE_QOS)

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """Call a service and return its answer.

        Raises:
            BusError: when nobody answers in time, the server refuses, or it serves another type.
        """
        name, deadline = full_name(service, self._node), time.monotonic() + timeout_s
        type_name, type_hash = _service_type(type(request), response)
        gid = self._client(name, type_name, type_hash)
        if not self._graph.wait(lambda: bool(self._graph.service_types(name)), timeout_s):
            raise BusError(f"Nobody served {name} within {timeout_s:g} s.", "start the node that serves it")
        if (type_name, type_hash) not in self._graph.service_types(name):
            served = sorted(self._graph.service_types(name))[0]
            raise BusError(
                f"The service {name} is a {served[0]} ({served[1]}), not a {type_name} ({type_hash}).",
                "correct the type",
            )
        replies = self._session.get(
            data_key(self._domain, name, type_name, type_hash), payload=encode(request),
            attachment=attachment(next(self._numbers), time.time_ns(), gid),
            target=self._zenoh.QueryTarget.ALL_COMPLETE, consolidation=self._zenoh.ConsolidationMode.NONE,
            timeout=max(0.001, deadline - time.monotonic()),
        )  # fmt: skip
        refusal = ""
        for reply in replies:
            if reply.ok is not None:
                return decode(response, reply.ok.payload.to_bytes())
            refusal = reply.err.payload.to_bytes().decode(errors="replace")
        if refusal and refusal != "Timeout":
            raise BusError(f"The service {name} refused: {refusal}.", "see the node that serves it")
        raise BusError(f"{name} did not answer within {timeout_s:g} s.", "see the node that serves it")

    def wait_for_peers(self, topics: tuple[str, ...], timeout_s: float) -> tuple[str, ...]:
        """Wait until each topic has a peer that hears this node; return those without."""
        deadline = time.monotonic() + timeout_s
        missing = super().wait_for_peers(topics, timeout_s)
        while (unreached := tuple(each for each in topics if each in missing or not self._reaches(each))) != missing:
            if time.monotonic() >= deadline:
                return unreached
            time.sleep(LOOK_S)
        return missing

    def _reaches(self, topic: str) -> bool:
        """Return whether what this node publishes on a topic has a way to a subscriber: a peer is known before it."""
        publishers = self._publishers.get(full_name(topic, self._node), ())
        return all(each.matching_status.matching for each in publishers if hasattr(each, "matching_status"))

    def _discover(self) -> None:
        time.sleep(max(0.0, self._opened_s + DISCOVERY_S - time.monotonic()))

    def _leave_transport(self) -> None:
        self._graph.close()
        for declared in reversed(self._declared):
            declared.undeclare()
        self._session.close()
        for inbox in self._inboxes:
            inbox.close()

    def _key(self, topic: str, message: type[Message]) -> str:
        return data_key(self._domain, topic, message.TYPE, rihs01(message))

    def _keep(self, declared: Any) -> Any:
        with self._lock:
            self._declared.append(declared)
        return declared

    def _announce(self, kind: str, topic: str, type_name: str, type_hash: str, qos: QoS) -> bytes:
        entity = Entity(self._id, kind, self._node, topic, type_name, type_hash)
        token = entity_token(self._domain, next(self._numbers), entity, qos)
        self._keep(self._session.liveliness().declare_token(token))
        self._graph.add_token(token)
        return gid_of(token)

    def _client(self, service: str, type_name: str, type_hash: str) -> bytes:
        if service not in self._clients:
            self._clients[service] = self._announce(CLIENT, service, type_name, type_hash, SERVICE_QOS)
        return self._clients[service]

    def _declare_publisher(self, key: str, qos: QoS) -> Any:
        zenoh = self._zenoh
        options = {
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
            "congestion_control": zenoh.CongestionControl.DROP,
        }
        if not qos.latched:
            return self._session.declare_publisher(key, **options)
        advanced = self._advanced
        return advanced.declare_advanced_publisher(
            self._session, key, **options, cache=advanced.CacheConfig(max(1, qos.depth)), publisher_detection=True,
            sample_miss_detection=advanced.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
        )  # fmt: skip


def _service_type(request: type[Message], response: type[Message]) -> tuple[str, str]:
    return request.TYPE.removesuffix("_Request"), service_rihs01(request, response)


def _answered(sent: Any) -> bytes:
    """Return the attachment of a response: the number and the sender of the request, and the time of now."""
    data = sent.to_bytes() if sent is not None else b""
    number, _, _, gid = ATTACHMENT.unpack(data) if len(data) == ATTACHMENT.size else (0, 0, 16, bytes(16))
    return attachment(number, time.time_ns(), gid)
