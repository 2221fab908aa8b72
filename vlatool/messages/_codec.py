"""What CDR and ROS 1 share: from a message to buffers, and from bytes to a message, with errors that name the field."""

from __future__ import annotations

import struct
from typing import Any, TypeVar, cast

from vlatool.errors import BusError
from vlatool.messages._plan import plan_of
from vlatool.messages._tails import Wire
from vlatool.messages._wrong_values import explain
from vlatool.messages.schema import Message

M = TypeVar("M", bound=Message)
LARGE_BYTES = 1024
"""Bytes from which a buffer is passed on by itself rather than copied together with others."""
UNFIT = (ValueError, struct.error, AttributeError, TypeError, OverflowError)
"""What a plan raises for a value that does not fit its field."""


def buffers(message: Message, wire: Wire, header: bytes = b"") -> list[Any]:
    """Return the bytes of a message in parts, behind a header.

    Raises:
        BusError: when a value does not fit its field; names the message and the field.
    """
    parts: list[Any] = [header]
    try:
        plan_of(type(message), wire).write(message, parts, 0)
    except UNFIT as error:
        raise explain(message, wire.ros1) or error from error
    return parts


def merge(parts: list[Any]) -> list[bytes | memoryview]:
    """Return buffers of which neighbours are joined, except large ones."""
    merged: list[bytes | memoryview] = []
    small: list[Any] = []
    for part in parts:
        if len(part) < LARGE_BYTES:
            small.append(part)
            continue
        if small:
            merged.append(b"".join(small))
            small = []
        merged.append(part)
    return [*merged, b"".join(small)] if small else merged


def read(cls: type[M], data: memoryview, wire: Wire, padding: int = 0) -> M:
    """Return the message of a type from its bytes, all of them.

    Args:
        cls: The type.
        data: Its bytes.
        wire: How they encode it.
        padding: Bytes that may follow it.

    Raises:
        BusError: for bytes that no message of this type has.
    """
    message, end = plan_of(cls, wire).read(data, 0)
    if end + padding < len(data):
        raise BusError(
            f"A malformed {cls.TYPE}: {len(data):,} bytes, of which it takes {end:,}.",
            "check that the publisher sends this type, in the version of its package that is installed there",
        )
    return cast(M, message)


def octets(buffer: Any) -> memoryview:
    """Return a contiguous buffer as its bytes, not copied.

    Raises:
        BusError: for what is none.
    """
    try:
        return memoryview(buffer).cast("B") if len(buffer) else memoryview(b"")
    except (TypeError, BufferError, ValueError):
        raise BusError(
            f"A message is decoded from contiguous bytes, not from {type(buffer).__name__}.", "pass bytes"
        ) from None
