"""What is on a Zenoh bus: the liveliness tokens of ROS 2's nodes, as they come and go."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from vlatool.buses._faults import Faults
from vlatool.buses._interface import TopicInfo
from vlatool.buses._zenoh_keys import CLIENT, PUBLISHER, SERVICE, SPACE, SUBSCRIBER, Entity, parse
from vlatool.errors import BusError

FIRST_LOOK_S = 3.0
"""How long the router may take to list the tokens that are there."""
CONVERSE = {PUBLISHER: (SUBSCRIBER,), SUBSCRIBER: (PUBLISHER,), SERVICE: (CLIENT,), CLIENT: (SERVICE,)}
"""Kind -> the kinds at the other end."""


class Graph:
    """Publishers, subscribers, services and clients on the bus.

    Args:
        zenoh: The library.
        session: An open session.
        domain: ROS domain.
        faults: Where another type on one of this node's topics is counted.
    """

    def __init__(self, zenoh: Any, session: Any, domain: int, faults: Faults) -> None:
        self._zenoh, self._faults = zenoh, faults
        self._changed = threading.Condition()
        self._entities: dict[str, Entity] = {}
        self._own_session = str(session.info.zid())
        pattern = f"{SPACE}/{domain}/**"
        heard = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(pattern, heard, history=True)
        for reply in session.liveliness().get(pattern, timeout=FIRST_LOOK_S):
            if reply.ok is not None:
                self._add(str(reply.ok.key_expr))

    def close(self) -> None:
        """Listen no longer."""
        self._subscriber.undeclare()

    def add_own(self, token: str) -> None:
        """Take in a token of this node at once."""
        self._add(token)

    def check_type(self, topic: str, type_name: str) -> None:
        """Raise BusError when others use another type on a topic."""
        with self._changed:
            for entity in self._entities.values():
                if entity.topic == topic and entity.kind in (PUBLISHER, SUBSCRIBER) and entity.type_name != type_name:
                    raise _other_type(entity, type_name)

    def service_types(self, service: str) -> set[tuple[str, str]]:
        """Return the names and hashes of the types under which others serve a service."""
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
            every = [entity for entity in self._entities.values() if entity.kind in (PUBLISHER, SUBSCRIBER)]
        names = sorted({entity.topic for entity in every})
        return [_topic_info(name, [entity for entity in every if entity.topic == name]) for name in names]

    def _hear(self, sample: Any) -> None:
        token = str(sample.key_expr)
        if sample.kind == self._zenoh.SampleKind.PUT:
            self._add(token)
            return
        with self._changed:
            self._entities.pop(token, None)
            self._changed.notify_all()

    def _add(self, token: str) -> None:
        entity = parse(token)
        if entity is None:
            return
        with self._changed:
            new = token not in self._entities
            self._entities[token] = entity
            self._changed.notify_all()
        if new and entity.session != self._own_session and entity.kind in (PUBLISHER, SUBSCRIBER):
            self._compare(entity)

    def _compare(self, entity: Entity) -> None:
        with self._changed:
            own = [one for one in self._entities.values() if one.session == self._own_session]
        for one in own:
            if one.topic == entity.topic and one.kind in (PUBLISHER, SUBSCRIBER) and one.type_name != entity.type_name:
                self._faults.add(entity.topic, _other_type(entity, one.type_name))
                return


def _other_type(entity: Entity, type_name: str) -> BusError:
    return BusError(
        f"The topic {entity.topic} carries {entity.type_name} (node {entity.node}), not {type_name}.",
        "remap one of the topics, or correct the type",
    )


def _topic_info(topic: str, entities: list[Entity]) -> TopicInfo:
    def nodes(kind: str) -> tuple[str, ...]:
        return tuple(sorted(entity.node for entity in entities if entity.kind == kind))

    types = tuple(sorted({entity.type_name for entity in entities}))
    return TopicInfo(topic, types, nodes(PUBLISHER), nodes(SUBSCRIBER))
