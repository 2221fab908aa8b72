"""The count of what goes wrong in the threads of a bus, where nobody could catch an error."""

from __future__ import annotations

import threading
from collections.abc import Callable

from vlatool.buses._interface import Fault
from vlatool.errors import BusError


class Faults:
    """Errors by topic: how many, and the latest; any thread may add one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._by_topic: dict[str, tuple[int, BusError | Callable[[], BusError]]] = {}

    def add(self, topic: str, error: BusError | Callable[[], BusError]) -> None:
        """Count an error on a topic or a service.

        Args:
            topic: The topic or service.
            error: The error, or what returns it when it is read: names of nodes may become known after their faults.
        """
        with self._lock:
            count, _ = self._by_topic.get(topic, (0, error))
            self._by_topic[topic] = count + 1, error

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
            entries = sorted((topic, *entry) for topic, entry in self._by_topic.items())
        return [
            Fault(topic, count, error if isinstance(error, BusError) else error()) for topic, count, error in entries
        ]
