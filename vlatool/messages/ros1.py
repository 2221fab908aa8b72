"""ROS 1's encoding of messages, with its names, texts of definitions and MD5 sums (Noetic).

Little endian without alignment; a string has no zero byte. What differs in the definition of a type stands in its
class (``schema.Ros1Form``). The sum is that of genmsg: over the constants and fields of a type, in which each type is
replaced by its own sum.
"""

from __future__ import annotations

import hashlib
from typing import Any

from vlatool.messages._codec import M, buffers, merge, octets, read
from vlatool.messages._members import cache, constants, members
from vlatool.messages._tails import Wire
from vlatool.messages.definition import ROS1_PRIMITIVES, full_text, own_text
from vlatool.messages.schema import Message, ros1_name

ROS1 = Wire(ros1=True)


def encode(message: Message) -> bytes:
    """Return the bytes of a message; ``seq`` of a header is 0.

    Raises:
        BusError: when a value does not fit its field; names the message and the field.
    """
    return b"".join(buffers(message, ROS1))


def encode_parts(message: Message) -> list[bytes | memoryview]:
    """Return the bytes of a message as buffers to send one after another; arrays of a kilobyte or more are not copied.

    Raises:
        BusError: when a value does not fit its field; names the message and the field.
    """
    return merge(buffers(message, ROS1))


def decode(cls: type[M], buffer: Any) -> M:
    """Return the message of a type from its bytes; arrays are read-only views of the buffer.

    Raises:
        BusError: for bytes that no message of this type has.
    """
    return read(cls, octets(buffer), ROS1)


def type_name(cls: type[Message]) -> str:
    """Return the name of a type: ``geometry_msgs/Twist``, ``std_srvs/SetBoolRequest``."""
    return ros1_name(cls.TYPE)


def service_name(request: type[Message]) -> str:
    """Return the name of the service of a request or response: ``std_srvs/SetBool``."""
    package, _, name = request.TYPE.split("/")
    return f"{package}/{name.rpartition('_')[0]}"


def definition(cls: type[Message]) -> str:
    """Return the definition of a type with those of the types in it."""
    return full_text(cls, ros1=True)


@cache
def md5sum(cls: type[Message]) -> str:
    """Return the sum by which ROS 1 recognizes a type."""
    return _md5(_summed_text(cls))


def service_md5sum(request: type[Message], response: type[Message]) -> str:
    """Return the sum by which ROS 1 recognizes a service."""
    return _md5(_summed_text(request) + _summed_text(response))


def _summed_text(cls: type[Message]) -> str:
    lines = [f"{entry.primitive} {entry.name}={entry.value}" for entry in constants(cls, ros1=True)]
    for member, line in zip(members(cls, ros1=True), own_text(cls, ros1=True).splitlines()[len(lines) :], strict=True):
        kind = member.message
        lines.append(line if kind is None or kind.TYPE in ROS1_PRIMITIVES else f"{md5sum(kind)} {member.name}")
    return "\n".join(lines)


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
