"""Clients of a protocol that does not say when one goes: the most silent one makes way for a new one."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

from vlatool.serving._service import Service, Session

IDLE_S = 60.0
"""After so long without a request a client makes way for another one."""
T = TypeVar("T")


class Clients(Generic[T]):
    """The sessions of the clients of one protocol, by what the protocol calls them.

    Args:
        protocol: Name of the protocol, for records.
        make: Returns what is kept of a client, from its session.
    """

    def __init__(self, service: Service, protocol: str, make: Callable[[Session], T]) -> None:
        self._service, self._protocol, self._make = service, protocol, make
        self._known: OrderedDict[Hashable, tuple[T, Session, float]] = OrderedDict()
        self._turn = threading.Lock()

    def get(self, client: Any) -> T:
        """Return what is kept of a client, which may be a new one.

        Raises:
            ServingError: when there are as many as there may be, and none was silent for long.
        """
        with self._turn:
            now = time.monotonic()
            if client not in self._known:
                self._make_way(now)
                name = client.hex()[:16] if isinstance(client, bytes) else str(client)
                session = self._service.session(f"{self._protocol} {name}")
                self._known[client] = self._make(session), session, now
            value, session, _ = self._known[client]
            self._known[client] = value, session, now
            self._known.move_to_end(client)
            return value

    def all(self) -> list[T]:
        """Return what is kept of all clients."""
        with self._turn:
            return [value for value, _, _ in self._known.values()]

    def _make_way(self, now: float) -> None:
        if not self._service.full or not self._known:
            return
        oldest, (_, session, last) = next(iter(self._known.items()))
        if now - last > IDLE_S:
            session.close()
            del self._known[oldest]
