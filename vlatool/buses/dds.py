"""DDS with ROS 2's names of topics and types, in Cyclone DDS: ROS 2 nodes on any DDS see and hear this node."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from vlatool.buses._dds_domain import join_domain, parse_address
from vlatool.buses._dds_endpoints import Endpoints
from vlatool.buses._dds_graph import DdsGraph
from vlatool.buses._dds_services import Client, serve_requests
from vlatool.buses._dds_types import describe
from vlatool.buses._graph_bus import GraphBus
from vlatool.buses._interface import QoS, Reception
from vlatool.buses._names import full_name, ros_type
from vlatool.errors import BusError, require
from vlatool.messages import Message
from vlatool.messages.cdr import decode, encode
from vlatool.messages.type_hash import rihs01

M = TypeVar("M", bound=Message)
DISCOVERY_S = 0.5
"""How long the others on this machine or network take to be found; types are compared after it."""


class Dds(GraphBus):
    """A node in a DDS domain.

    Args:
        address: Number of the domain, and behind ``@`` the interface to use alone, such as ``0@127.0.0.1``; without a
            number, ``ROS_DOMAIN_ID`` or 0; without an interface, what Cyclone DDS or ``CYCLONEDDS_URI`` chooses.
        node: Name of this node.

    Raises:
        UsageError: for an impossible address, domain or name.
        MissingExtra: when cyclonedds is absent.
        BusError: when the domain cannot be opened.
    """

    def __init__(self, address: str, node: str) -> None:
        super().__init__(node)
        number, interface = parse_address(address)
        require("cyclonedds", "dds")
        self._leave = join_domain(number, interface, self._refused)
        try:
            self._endpoints = Endpoints(number)
        except BusError:
            self._leave()
            raise
        self._opened_s = time.monotonic()
        self._graph: DdsGraph = DdsGraph(self._endpoints, node, self._faults)
        self._clients: dict[str, Client] = {}

    def subscribe(self, topic: str, message: type[M], handler: Callable[[Reception], None], qos: QoS) -> None:
        """Call ``handler`` with each message of a topic, in a thread of the subscription.

        Raises:
            BusError: when the topic carries another type.
        """
        name = self._check(topic, message)

        def handle(data: bytes, received_s: float) -> None:
            try:
                handler(Reception(decode(message, data), received_s))
            except Exception as error:  # a handler may raise anything; the bus goes on
                self._faults.add_raised(name, error)

        reader = self._endpoints.reader(f"rt{name}", describe(message), qos, rihs01(message), handle)
        self._graph.add_own(reader=reader.guid.bytes)

    def publisher(self, topic: str, message: type[M], qos: QoS) -> Callable[[M], None]:
        """Announce a topic and return what sends a message on it; it never blocks: what cannot be sent is a fault.

        Raises:
            BusError: when the topic carries another type.
        """
        name = self._check(topic, message)
        write = self._endpoints.writer(f"rt{name}", describe(message), qos, rihs01(message))
        self._graph.add_own(writer=write.guid)

        def send(value: M) -> None:
            data = encode(value)
            self._check_open(name)
            try:
                write(data)
            except BusError as error:
                self._faults.add(name, error)

        return send

    def serve(self, service: str, request: type[Message], response: type[M], handler: Callable[[Message], M]) -> None:
        """Answer a service, each request in a thread of its own."""
        name = full_name(service, self._node)
        self._check_open(name)
        reader, writer = serve_requests(self._endpoints, name, request, response, handler, self._faults)
        self._graph.add_own(reader, writer)

    def call(self, service: str, request: Message, response: type[M], timeout_s: float) -> M:
        """Call a service and return its answer.

        Raises:
            BusError: when nobody answers in time.
        """
        name, deadline = full_name(service, self._node), time.monotonic() + timeout_s
        self._check_open(name)
        with self._lock:
            if name not in self._clients:
                self._clients[name] = client = Client(self._endpoints, name, type(request), response, self._faults)
                self._graph.add_own(client.reader_guid, client.writer_guid)
        return self._clients[name].call(request, response, deadline, timeout_s)

    def _leave_transport(self) -> None:
        self._endpoints.close()
        self._leave()

    def _discover(self) -> None:
        time.sleep(max(0.0, self._opened_s + DISCOVERY_S - time.monotonic()))

    def _refused(self, topic: str, type_name: str) -> None:
        name = "/" + topic.partition("/")[2]
        problem = f"A malformed {ros_type(type_name)} came on {name}; DDS refused it."
        self._faults.add(name, BusError(problem, "check that the publisher sends messages of this type"))
