"""The count of what goes wrong in the threads of a bus, where nobody could catch an error."""

from __future__ import annotations

import threading

from vlatool.buses._interface import Fault
from vlatool.errors import BusError


class Faults:
    """Errors by topic: how many, and the latest; any thread may add one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._by_topic: dict[str, Fault] = {}

    def add(self, topic: str, error: BusError) -> None:
        """Count an error on a topic or a service."""
        with self._lock:
            before = self._by_topic.get(topic)
            self._by_topic[topic] = Fault(topic, before.count + 1 if before else 1, error)

    def add_raised(self, topic: str, error: Exception) -> None:
        """Count what a handler raised."""
        if isinstance(error, BusError):
            self.add(topic, error)
            return
        problem = f"The handler of {topic} raised {type(error).__name__}: {error}."
        self.add(topic, BusError(problem, "correct the handler; the bus goes on with the next message"))

    def listing(self) -> list[Fault]:
        """Return one entry for each topic with a fault, sorted by topic."""
        with self._lock:
            return [self._by_topic[topic] for topic in sorted(self._by_topic)]
