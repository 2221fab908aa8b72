"""Messages of Protocol Buffers with numbers and bytes alone, as LeRobot's service has them.

Source: https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vlatool.errors import DataError

FIX = "send what the .proto of the service describes"
MAX_FIELDS = 64
SIZES = {1: 8, 5: 4}
"""Wire type of a fixed size -> bytes."""


def fields(message: bytes, known: Mapping[int, type]) -> dict[int, Any]:
    """Return the known fields of a message by number: ``int`` for a varint, ``bytes``; others are left out.

    Raises:
        DataError: when the message is damaged.

    Example:
        >>> fields(bytes.fromhex("0803") + bytes_field(2, b"ab"), {1: int, 2: bytes})
        {1: 3, 2: b'ab'}
    """
    found: dict[int, Any] = {}
    at = count = 0
    while at < len(message):
        tag, at = _varint(message, at)
        kind, value = tag & 7, b""
        if kind == 0:
            number, at = _varint(message, at)
            if known.get(tag >> 3) is int:
                found[tag >> 3] = number
        elif kind == 2 or kind in SIZES:
            size, at = _varint(message, at) if kind == 2 else (SIZES[kind], at)
            value, at = message[at : at + size], at + size
            if known.get(tag >> 3) is bytes and kind == 2:
                found[tag >> 3] = value
        count += 1
        if kind not in (0, 1, 2, 5) or at > len(message) or not tag >> 3 or count > MAX_FIELDS:
            raise DataError("The message is damaged, or of another service.", FIX)
    return found


def bytes_field(number: int, value: bytes) -> bytes:
    """Return a field with bytes as it is in a message.

    Example:
        >>> bytes_field(1, b"ab").hex()
        '0a026162'
    """
    length, size = bytearray(), len(value)
    while size > 0x7F:
        length.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes([number << 3 | 2, *length, size]) + value


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """Return a number of up to 64 bits, and where it ends."""
    number = 0
    for index in range(10):
        if at + index >= len(message):
            break
        byte = message[at + index]
        number |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return number, at + index + 1
    raise DataError("The message is damaged: a number does not end.", FIX)
