"""A ring of records between threads, without a lock."""

from __future__ import annotations

import itertools
from typing import Any


class Ring:
    """The last records, of any number of writers: to put one in takes the same time, whoever reads, or nobody.

    Args:
        size: Number of records that are held; a reader that is farther behind loses the oldest, and counts them.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._slots: list[tuple[int, Any] | None] = [None] * size
        self._numbers = itertools.count()

    def put(self, record: Any) -> None:
        """Add a record, in the place of the oldest."""
        number = next(self._numbers)  # one step of the interpreter: no two writers get the same
        self._slots[number % self.size] = number, record

    def get(self, number: int) -> tuple[int, Any] | None:
        """Return what is in the slot of a number: that record, one before or after it, or nothing yet."""
        return self._slots[number % self.size]


class Reader:
    """One reader of a ring, from where the ring is empty.

    Attributes:
        taken: Records that were returned.
        dropped: Records that were overwritten before they were.
    """

    def __init__(self, ring: Ring) -> None:
        self._ring, self._next = ring, 0
        self.taken = self.dropped = 0

    def take(self) -> Any | None:
        """Return the oldest record that was not returned yet; None when there is none."""
        while (slot := self._ring.get(self._next)) is not None and slot[0] >= self._next:
            number, record = slot
            if number == self._next:
                self._next += 1
                self.taken += 1
                return record
            oldest = number - self._ring.size + 1
            self.dropped += oldest - self._next
            self._next = oldest
        return None
