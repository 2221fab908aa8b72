"""Key expressions, liveliness tokens and attachments of rmw_zenoh, the ROS 2 middleware on Zenoh.

Layout of tokens: the page on the design of rmw_zenoh and its ``liveliness_utils.cpp``; of attachments: its 33 bytes.
"""

from __future__ import annotations

import hashlib
import struct

from vlatool.buses._graph import CLIENT, PUBLISHER, SERVICE, SUBSCRIBER, Entity
from vlatool.buses._interface import QoS
from vlatool.buses._names import dds_type, ros_type

SPACE = "@ros2_lv"
"""First part of every liveliness token."""
NODE = "NN"
"""Kind of a node's token; the other kinds are those of the graph."""
NO_NAME = "%"
"""What stands for an empty name and for each slash in one."""
ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, nanoseconds since the epoch, length of what follows, identifier of the sender (gid)."""
PARTS = 13
"""Parts of the token of a publisher, a subscriber, a service or a client."""


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the key expression that carries the messages of a topic, or the requests of a service."""
    return f"{domain}/{topic.lstrip('/')}/{dds_type(type_name)}/{type_hash}"


def node_token(domain: int, session: str, node: str) -> str:
    """Return the liveliness token of a node."""
    return f"{SPACE}/{domain}/{session}/0/0/{NODE}/{NO_NAME}/{NO_NAME}/{node}"


def entity_token(domain: int, number: int, entity: Entity, qos: QoS) -> str:
    """Return the liveliness token of a publisher, a subscriber, a service or a client.

    Args:
        domain: ROS domain.
        number: Its number within the session, from 1.
        entity: What it is.
        qos: Quality of service that it states.
    """
    mangled = entity.topic.replace("/", NO_NAME)
    return (
        f"{SPACE}/{domain}/{entity.session}/0/{number}/{entity.kind}/{NO_NAME}/{NO_NAME}/{entity.node}/{mangled}/"
        f"{dds_type(entity.type_name)}/{entity.type_hash}/{qos_text(qos)}"
    )


def qos_text(qos: QoS) -> str:
    """Return a quality of service as a token has it: kinds by ROS 2's numbers, no deadline, lifespan or lease."""
    return f"{1 if qos.reliable else 2}:{1 if qos.latched else 2}:1,{max(1, qos.depth)}:,:,:,,"


def parse(token: str) -> Entity | None:
    """Return what a token describes; None for that of a node, and for what rmw_zenoh does not write."""
    parts = token.split("/")
    if len(parts) != PARTS or parts[0] != SPACE or parts[5] not in (PUBLISHER, SUBSCRIBER, SERVICE, CLIENT):
        return None
    namespace = parts[7].replace(NO_NAME, "/").strip("/")
    node = f"{namespace}/{parts[8]}" if namespace else parts[8]
    topic = "/" + parts[9].replace(NO_NAME, "/").lstrip("/")
    return Entity(parts[2], parts[5], node, topic, ros_type(parts[10]), parts[11])


def gid_of(token: str) -> bytes:
    """Return the identifier, 16 bytes, of what a token describes."""
    return hashlib.blake2b(token.encode(), digest_size=16).digest()


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """Return the 33 bytes that go beside a message, a request or a response."""
    return ATTACHMENT.pack(sequence, stamp_ns, len(gid), gid)
