"""Content of messages: a number that tells one from another on every bus, and the text of a small one for a record."""

from __future__ import annotations

import zlib

from vlatool.errors import BusError, DataError, UsageError
from vlatool.messages import Message, find_type
from vlatool.messages.cdr import decode, encode, encode_parts

MAX_SUMMED = 1_000_000
"""Bytes of a message from its beginning that a digest covers, and with them its stamp; a cloud may have ten times as
many, whose sum would take milliseconds."""
MAX_TEXT = 2048
"""Bytes of a message that is written out in a record; of a larger one the digest is."""


def digest(message: Message) -> str:
    """Return what tells a message from others: CRC-32 and length of its CDR, such as ``5f3a01c2:52``."""
    parts = encode_parts(message)
    crc, left = 0, MAX_SUMMED
    for part in parts:
        crc = zlib.crc32(memoryview(part).cast("B")[:left] if left else b"", crc)
        left = max(0, left - len(part))
    return f"{crc:08x}:{sum(map(len, parts))}"


def to_text(message: Message) -> str:
    """Return a message as text: its type and its CDR in hexadecimal, or its digest where that is long.

    Example:
        >>> from vlatool.messages.std_msgs import Bool
        >>> to_text(Bool(True))
        'std_msgs/msg/Bool=0001000001'
    """
    content = encode(message)
    return f"{message.TYPE}={content.hex()}" if len(content) <= MAX_TEXT else f"{message.TYPE}#{digest(message)}"


def digest_of(text: str) -> str:
    """Return the digest of a message that ``to_text`` wrote out."""
    return digest(from_text(text)) if "=" in text else text.partition("#")[2]


def from_text(text: str) -> Message:
    """Return the message that ``to_text`` wrote out.

    Raises:
        DataError: when it is none, or the digest of a long one.
    """
    name, mark, content = text.partition("=")
    try:
        if not mark:
            raise ValueError("a digest")
        return decode(find_type(name), bytes.fromhex(content))
    except (ValueError, BusError, UsageError):
        raise DataError(f"A recorded message is '{text:.60}', which cannot be read.", "record the run again") from None
