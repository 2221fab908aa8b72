"""The graph of a DDS domain: endpoints from DDS's discovery, names of nodes from ROS 2's ``ros_discovery_info``.

Topics, types and the content of ``ros_discovery_info`` are those of rmw_dds_common since ROS 2 Iron: identifiers of 16
bytes. Nodes of Humble and before, whose identifiers have 24, are listed by their participants' identifiers.
"""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vlatool.buses._dds_types import describe
from vlatool.buses._faults import Faults
from vlatool.buses._graph import CLIENT, PUBLISHER, SERVICE, SUBSCRIBER, Entity, Graph
from vlatool.buses._interface import QoS
from vlatool.buses._names import ros_type
from vlatool.errors import BusError, require
from vlatool.messages import Message
from vlatool.messages.cdr import decode, encode
from vlatool.messages.schema import string, uint8_16, zeros

NODES = "ros_discovery_info"
"""Topic on which each participant of ROS 2 says which endpoints belong to which node."""
NODES_QOS = QoS(reliable=True, depth=1, latched=True)
HEARD_NODES_QOS = QoS(reliable=True, depth=1000, latched=True)
"""The topic has no key: with a depth of 1, a participant that speaks before the reader has looked would replace what
the one before it said. ROS 2 keeps all."""
PREFIXES = {
    ("rt", PUBLISHER): PUBLISHER, ("rt", SUBSCRIBER): SUBSCRIBER,
    ("rq", SUBSCRIBER): SERVICE, ("rq", PUBLISHER): CLIENT,
}  # fmt: skip
"""Prefix of a topic and kind of an endpoint -> what it is in ROS 2; replies are those of known services and clients."""


@dataclass(frozen=True, eq=False)
class Gid(Message):
    """Identifier of an endpoint or a participant."""

    TYPE: ClassVar[str] = "rmw_dds_common/msg/Gid"
    data: uint8_16 = zeros("uint8", 16)  # noqa: RUF009  # a field with a factory


@dataclass(frozen=True, eq=False)
class NodeEntities(Message):
    """A node and its endpoints."""

    TYPE: ClassVar[str] = "rmw_dds_common/msg/NodeEntitiesInfo"
    node_namespace: string = ""
    node_name: string = ""
    reader_gid_seq: tuple[Gid, ...] = ()
    writer_gid_seq: tuple[Gid, ...] = ()


@dataclass(frozen=True, eq=False)
class ParticipantEntities(Message):
    """A participant and its nodes."""

    TYPE: ClassVar[str] = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid: Gid = Gid()  # messages are immutable
    node_entities_info_seq: tuple[NodeEntities, ...] = ()


class DdsGraph(Graph):
    """Publishers, subscribers, services and clients in a domain, and this node among them.

    Args:
        endpoints: What makes readers and writers in the participant.
        node: Name of this node.
        faults: Where what does not fit on one of this node's topics is counted.
    """

    def __init__(self, endpoints: Any, node: str, faults: Faults) -> None:
        self._participant = endpoints.participant
        self._gid = self._participant.guid.bytes
        super().__init__(self._gid.hex(), faults)
        self._node, self._lock = node, threading.Lock()
        self._readers: list[bytes] = []
        self._writers: list[bytes] = []
        self._nodes: dict[str, dict[str, str]] = {}
        described = describe(ParticipantEntities)
        self._write = endpoints.writer(NODES, described, NODES_QOS, "")
        endpoints.reader(NODES, described, HEARD_NODES_QOS, "", self._hear_nodes)
        builtin = require("cyclonedds.builtin", "dds")
        endpoints.watch(builtin.BuiltinTopicDcpsPublication, lambda sample: self._hear_endpoint(sample, PUBLISHER))
        endpoints.watch(builtin.BuiltinTopicDcpsSubscription, lambda sample: self._hear_endpoint(sample, SUBSCRIBER))
        self._tell()

    def add_own(self, reader: bytes | None = None, writer: bytes | None = None) -> None:
        """Say that endpoints, by their identifiers, belong to this node."""
        with self._lock:
            self._readers += [reader] if reader else []
            self._writers += [writer] if writer else []
            self._tell()

    def node_of(self, entity: Entity) -> str:
        """Return the name of an entity's node, or of its participant when no node claims it."""
        if entity.session == self._own_session:
            return self._node
        with self._changed:
            return self._nodes.get(entity.session, {}).get(entity.node, f"participant {entity.session}")

    def _tell(self) -> None:
        def gids(own: list[bytes]) -> tuple[Gid, ...]:
            return tuple(Gid(np.frombuffer(gid, np.uint8)) for gid in own)

        node = NodeEntities("/", self._node, gids(self._readers), gids(self._writers))
        participant = ParticipantEntities(Gid(np.frombuffer(self._gid, np.uint8)), (node,))
        self._write(encode(participant))

    def _hear_nodes(self, data: bytes, _: float) -> None:
        try:
            told = decode(ParticipantEntities, data)
        except BusError as error:
            self._faults.add(f"/{NODES}", error)
            return
        names = {}
        for node in told.node_entities_info_seq:
            name = f"{node.node_namespace}/{node.node_name}".strip("/").replace("//", "/")
            names.update({gid.data.tobytes().hex(): name for gid in (*node.reader_gid_seq, *node.writer_gid_seq)})
        with self._changed:  # a node that leaves takes its endpoints back first: faults go on naming it
            self._nodes.setdefault(told.gid.data.tobytes().hex(), {}).update(names)
            self._changed.notify_all()

    def _hear_endpoint(self, sample: Any, end: str) -> None:
        identifier = sample.key.bytes.hex()
        if not sample.sample_info.valid_data or sample.topic_name is None:
            self.remove(identifier)
            return
        prefix, slash, rest = sample.topic_name.partition("/")
        kind = PREFIXES.get((prefix, end))
        if kind is None or not slash:
            return
        name = rest.removesuffix("Request") if prefix == "rq" else rest
        type_name = ros_type(sample.type_name).removesuffix("_Request" if prefix == "rq" else "\0")
        session = sample.participant_key.bytes.hex()
        self.add(identifier, Entity(session, kind, identifier, f"/{name}", type_name, *_qos(sample.qos)))


def _qos(stated: Any) -> tuple[str, QoS]:
    """Return hash of the type and quality of service from an endpoint's policies."""
    policies = {str(getattr(policy, "__scope__", "")): policy for policy in stated or ()}
    data = getattr(policies.get("Userdata"), "data", b"")
    found = re.search(rb"typehash=(RIHS01_[0-9a-f]{64});", data)
    reliable = "Reliable" in type(policies.get("Reliability")).__qualname__
    latched = "Volatile" not in repr(policies.get("Durability", "Volatile"))
    return found.group(1).decode() if found else "", QoS(reliable, 1, latched)
