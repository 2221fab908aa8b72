"""The parts of a message whose length may vary: strings, arrays of numbers, each written and read at a position.

A tail first prepares what it writes: a count, which the fields before it carry in front of it, and a payload. Positions
count from the start of the payload, from which CDR aligns; ROS 1 aligns nothing and ends no string with a zero byte.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from vlatool.messages._wrong_values import WrongValue, fit_array

PADS = tuple(bytes(count) for count in range(8))
"""Count -> as many zero bytes."""
LENGTH = np.dtype("uint32").itemsize


class Wire(NamedTuple):
    """How messages become bytes.

    Args:
        ros1: ROS 1's form; else CDR (XCDR1).
        order: Byte order as in ``struct``: ``<`` or ``>``.
    """

    ros1: bool = False
    order: str = "<"


class Malformed(ValueError):
    """Bytes that no message has; the text says why."""


class Tail(Protocol):
    """Writes and reads one field of variable length."""

    counted: bool
    """Whether its count stands in front of it."""
    smallest: int
    """Fewest bytes that it takes, those of the count left out."""

    def prepare(self, value: Any) -> tuple[int, Any]:
        """Return its count and what ``write`` needs; raises WrongValue for a value that does not fit."""

    def write(self, payload: Any, parts: list[Any], position: int) -> int:
        """Append the bytes, which begin at ``position``; return where they end."""

    def read(self, data: memoryview, position: int, count: int) -> tuple[Any, int]:
        """Return the value, and where its bytes end; raises Malformed."""


class Text:
    """A string; in CDR, its count includes a zero byte at the end."""

    counted, smallest = True, 0

    def __init__(self, wire: Wire) -> None:
        self.end = b"" if wire.ros1 else b"\0"

    def prepare(self, value: Any) -> tuple[int, Any]:
        """Return the length and the bytes of a string."""
        if not isinstance(value, str):
            raise WrongValue
        text = value.encode() + self.end
        return len(text), text

    def write(self, payload: Any, parts: list[Any], position: int) -> int:
        """Append the text."""
        parts.append(payload)
        return position + len(payload)

    def read(self, data: memoryview, position: int, count: int) -> tuple[Any, int]:
        """Return the text; an empty one may lack its zero byte, as in some implementations of DDS."""
        end = position + count
        if end > len(data):
            raise Malformed(f"a string of {count:,} bytes, where {len(data) - position:,} are left")
        if count and self.end and data[end - 1]:
            raise Malformed("a string without the zero byte at its end")
        try:
            return str(data[position : end - len(self.end) if count else end], "utf-8"), end
        except UnicodeDecodeError:
            raise Malformed("a string that is not UTF-8") from None


class Texts:
    """A sequence of strings."""

    counted, smallest = True, 0

    def __init__(self, wire: Wire) -> None:
        self.text, self.mask = Text(wire), 0 if wire.ros1 else 3
        self.order = "big" if wire.order == ">" else "little"

    def prepare(self, value: Any) -> tuple[int, Any]:
        """Return the count of the strings, and each with its length."""
        if not isinstance(value, (tuple, list)):
            raise WrongValue
        return len(value), [self.text.prepare(item) for item in value]

    def write(self, payload: Any, parts: list[Any], position: int) -> int:
        """Append each length and text."""
        for count, text in payload:
            pad = -position & self.mask
            parts.append(PADS[pad] + count.to_bytes(LENGTH, self.order) + text)
            position += pad + LENGTH + count
        return position

    def read(self, data: memoryview, position: int, count: int) -> tuple[Any, int]:
        """Return a tuple of the strings."""
        check_count(count, LENGTH, data, position)
        texts = []
        for _ in range(count):
            position += -position & self.mask
            if position + LENGTH > len(data):
                raise Malformed("the bytes end before a string")
            length = int.from_bytes(data[position : position + LENGTH], self.order)  # type: ignore[arg-type]
            text, position = self.text.read(data, position + LENGTH, length)
            texts.append(text)
        return tuple(texts), position


class Numbers:
    """An array or a sequence of numbers of a fixed size; what is read is a read-only view of the bytes."""

    def __init__(self, wire: Wire, primitive: str, length: int) -> None:
        self.native, self.length, self.counted = np.dtype(primitive), length, not length
        self.dtype = self.native.newbyteorder(wire.order)  # type: ignore[arg-type]
        self.size = self.dtype.itemsize
        self.mask = 0 if wire.ros1 else self.size - 1
        self.smallest = length * self.size

    def prepare(self, value: Any) -> tuple[int, Any]:
        """Return the length of the array, and the array in the byte order of the wire."""
        array = fit_array(value, self.native, self.length)
        return array.shape[0], array if self.dtype == self.native else array.astype(self.dtype)

    def write(self, payload: Any, parts: list[Any], position: int) -> int:
        """Append the numbers, not copied."""
        if not payload.shape[0]:
            return position
        if pad := -position & self.mask:
            parts.append(PADS[pad])
        parts.append(payload.data.cast("B"))
        return position + pad + int(payload.nbytes)

    def read(self, data: memoryview, position: int, count: int) -> tuple[Any, int]:
        """Return the array."""
        count = self.length or count
        if not count:
            return np.zeros(0, self.native), position
        position += -position & self.mask
        end = position + count * self.size
        if end > len(data):
            raise Malformed(
                f"{count:,} numbers of {self.size} bytes each, where {max(0, len(data) - position):,} bytes are left"
            )
        array = np.frombuffer(data, self.dtype, count, position)
        if self.dtype != self.native:
            array = array.astype(self.native)
        array.flags.writeable = False
        return array, end


def check_count(count: int, smallest: int, data: memoryview, position: int) -> None:
    """Refuse a count of elements, of ``smallest`` bytes at least, that the bytes cannot hold: nothing is allocated.

    Raises:
        Malformed: when fewer bytes are left.
    """
    left = max(0, len(data) - position)
    if count * max(1, smallest) > left:
        raise Malformed(f"{count:,} elements of at least {max(1, smallest)} bytes each, where {left:,} bytes are left")
