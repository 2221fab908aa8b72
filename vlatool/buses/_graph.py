"""What is on a bus: publishers, subscribers, services and clients, as they come and go."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vlatool.buses._faults import Faults
from vlatool.buses._interface import QoS, TopicInfo
from vlatool.errors import BusError

PUBLISHER, SUBSCRIBER, SERVICE, CLIENT = "MP", "MS", "SS", "SC"
"""Kinds, as rmw_zenoh abbreviates them."""
CONVERSE = {PUBLISHER: (SUBSCRIBER,), SUBSCRIBER: (PUBLISHER,), SERVICE: (CLIENT,), CLIENT: (SERVICE,)}
"""Kind -> the kinds at the other end."""


class Entity(NamedTuple):
    """A publisher, subscriber, service or client.

    Args:
        session: Identifier of its session on the bus, such as a Zenoh session or a DDS participant.
        kind: ``MP``, ``MS``, ``SS`` or ``SC``.
        node: Name of its node, with the namespace if it is in one.
        topic: Full name of its topic or service.
        type_name: ROS 2 name of its type.
        type_hash: RIHS01 hash of its type; empty when it states none.
        qos: Its quality of service where the bus matches by that; else None.
    """

    session: str
    kind: str
    node: str
    topic: str
    type_name: str
    type_hash: str = ""
    qos: QoS | None = None


class Graph:
    """The entities on a bus by their identifiers; threads of the bus add and remove them.

    Args:
        own_session: Identifier of this node's session.
        faults: Where what does not fit on one of this node's topics is counted.
    """

    def __init__(self, own_session: str, faults: Faults) -> None:
        self._own_session, self._faults = own_session, faults
        self._changed = threading.Condition()
        self._entities: dict[str, Entity] = {}

    def add(self, identifier: str, entity: Entity) -> None:
        """Take in an entity; one that does not fit this node's is counted as a fault, once."""
        with self._changed:
            new = identifier not in self._entities
            self._entities[identifier] = entity
            self._changed.notify_all()
            others = [one for one in self._entities.values() if one.topic == entity.topic and one is not entity]
        if new and entity.kind in (PUBLISHER, SUBSCRIBER):
            self._compare(entity, [one for one in others if one.kind in (PUBLISHER, SUBSCRIBER)])

    def remove(self, identifier: str) -> None:
        """Take out an entity."""
        with self._changed:
            self._entities.pop(identifier, None)
            self._changed.notify_all()

    def node_of(self, entity: Entity) -> str:
        """Return the name of an entity's node."""
        return entity.node

    def check_type(self, topic: str, type_name: str) -> None:
        """Raise BusError when a topic carries another type."""
        for entity in self._on(topic):
            if entity.type_name != type_name:
                raise self._other_type(entity, type_name)

    def service_types(self, service: str) -> set[tuple[str, str]]:
        """Return the names and hashes of the types under which a service is served."""
        with self._changed:
            found = [entity for entity in self._entities.values() if (entity.kind, entity.topic) == (SERVICE, service)]
        return {(entity.type_name, entity.type_hash) for entity in found}

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Return whether a condition on this graph holds within a time."""
        with self._changed:
            return self._changed.wait_for(condition, timeout_s)

    def has_peer(self, topic: str) -> bool:
        """Return whether another node is at the other end of a topic; at any end of one that this node does not use."""
        with self._changed:
            here = [entity for entity in self._entities.values() if entity.topic == topic]
        own = {entity.kind for entity in here if entity.session == self._own_session}
        wanted = {kind for one in own for kind in CONVERSE[one]} or set(CONVERSE)
        return any(entity.kind in wanted for entity in here if entity.session != self._own_session)

    def topics(self) -> list[TopicInfo]:
        """Return the topics, sorted by name."""
        with self._changed:
            names = sorted({one.topic for one in self._entities.values() if one.kind in (PUBLISHER, SUBSCRIBER)})
        return [self._topic_info(name) for name in names]

    def _on(self, topic: str) -> list[Entity]:
        with self._changed:
            every = list(self._entities.values())
        return [entity for entity in every if entity.topic == topic and entity.kind in (PUBLISHER, SUBSCRIBER)]

    def _topic_info(self, topic: str) -> TopicInfo:
        entities = self._on(topic)

        def nodes(kind: str) -> tuple[str, ...]:
            return tuple(sorted(self.node_of(entity) for entity in entities if entity.kind == kind))

        types = tuple(sorted({entity.type_name for entity in entities}))
        return TopicInfo(topic, types, nodes(PUBLISHER), nodes(SUBSCRIBER))

    def _compare(self, entity: Entity, others: list[Entity]) -> None:
        for one in others:
            if (one.session == self._own_session) == (entity.session == self._own_session):
                continue
            own, foreign = (one, entity) if one.session == self._own_session else (entity, one)
            if own.type_name != foreign.type_name:
                self._faults.add(entity.topic, partial(self._other_type, foreign, own.type_name))
            elif own.kind != foreign.kind and (wants := _unmatched(own, foreign)):
                self._faults.add(entity.topic, partial(self._no_messages, foreign, wants))

    def _other_type(self, entity: Entity, type_name: str) -> BusError:
        return BusError(
            f"The topic {entity.topic} carries {entity.type_name} (node {self.node_of(entity)}), not {type_name}.",
            "remap one of the topics, or correct the type",
        )

    def _no_messages(self, foreign: Entity, wants: str) -> BusError:
        return BusError(
            f"No messages pass on {foreign.topic} between this node and {self.node_of(foreign)}: the subscriber asks "
            f"for {wants}.",
            "give both ends one quality of service",
        )


def _unmatched(own: Entity, foreign: Entity) -> str:
    """Return what a subscriber asks for and its publisher does not offer; empty where they match."""
    publisher, subscriber = (own, foreign) if own.kind == PUBLISHER else (foreign, own)
    if publisher.qos is None or subscriber.qos is None:
        return ""
    wants = []
    if subscriber.qos.reliable and not publisher.qos.reliable:
        wants.append("'reliable', and the publisher is 'best effort'")
    if subscriber.qos.latched and not publisher.qos.latched:
        wants.append("'transient local', and the publisher is 'volatile'")
    return " and for ".join(wants)
