"""CDR, the encoding of ROS 2's messages: XCDR version 1 behind an encapsulation header of four bytes.

Written in little endian, read in both byte orders. The rules of alignment are those of DDSI-RTPS 2.2, section 10, and
of CORBA 3.0.3, section 15.3: each primitive at a multiple of its size, counted from behind the header.
"""

from __future__ import annotations

from typing import Any

from vlatool.errors import BusError
from vlatool.messages._codec import M, buffers, merge, octets, read
from vlatool.messages._tails import Wire
from vlatool.messages.schema import Message

HEADER = bytes((0, 1, 0, 0))
"""Plain CDR in little endian, without options."""
MAX_PADDING = 3
"""Bytes that may follow a message, so that its length is a multiple of four."""
LITTLE_ENDIAN, BIG_ENDIAN = Wire(), Wire(order=">")


def encode(message: Message) -> bytes:
    """Return the bytes of a message.

    Raises:
        BusError: when a value does not fit its field; names the message and the field.
    """
    return b"".join(buffers(message, LITTLE_ENDIAN, HEADER))


def encode_parts(message: Message) -> list[bytes | memoryview]:
    """Return the bytes of a message as buffers to send one after another; arrays of a kilobyte or more are not copied.

    Raises:
        BusError: when a value does not fit its field; names the message and the field.
    """
    return merge(buffers(message, LITTLE_ENDIAN, HEADER))


def decode(cls: type[M], buffer: Any) -> M:
    """Return the message of a type from its bytes; arrays are read-only, those in little endian views of the buffer.

    Args:
        cls: The type.
        buffer: Contiguous bytes, with the encapsulation header.

    Raises:
        BusError: for bytes that no message of this type has.
    """
    data = octets(buffer)
    if len(data) < len(HEADER):
        raise BusError(
            f"A malformed {cls.TYPE}: {len(data)} bytes, fewer than the header of CDR has.",
            "check that the publisher sends ROS 2 messages",
        )
    if data[0] or data[1] > 1:
        raise BusError(
            f"A {cls.TYPE} in the encoding 0x{data[0]:02x}{data[1]:02x}, not in plain CDR (0x0000 or 0x0001).",
            "set the publisher's data representation to XCDR1, which ROS 2 uses",
        )
    return read(cls, data[len(HEADER) :], LITTLE_ENDIAN if data[1] else BIG_ENDIAN, MAX_PADDING)
