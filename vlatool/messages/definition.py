"""Definitions of message types as text: fields and constants, then those of the types in it, each behind its name.

The form is that of rosbags, without comments, default values and blank lines: constants first, then fields.
"""

from __future__ import annotations

from vlatool.messages._members import Member, constants, members
from vlatool.messages.schema import Message

SEPARATOR = "=" * 80
ROS1_PRIMITIVES = {"builtin_interfaces/msg/Time": "time", "builtin_interfaces/msg/Duration": "duration"}
"""Types that are primitives in ROS 1."""


def text(cls: type[Message]) -> str:
    """Return the ROS 2 definition of a type with those of the types in it."""
    return full_text(cls)


def full_text(cls: type[Message], ros1: bool = False) -> str:
    """Return the definition of a type with those of the types in it, as ROS 2 or ROS 1 has it."""
    parts = [own_text(cls, ros1)]
    parts += [f"{SEPARATOR}\nMSG: {short_name(kind)}\n{own_text(kind, ros1)}" for kind in types_in(cls, ros1)]
    return "".join(parts)


def own_text(cls: type[Message], ros1: bool = False) -> str:
    """Return the definition of a type alone, a line for each constant and field."""
    lines = [f"{entry.primitive} {entry.name}={entry.value}" for entry in constants(cls, ros1)]
    lines += [f"{element_name(member, ros1)}{_brackets(member)} {member.name}" for member in members(cls, ros1)]
    return "".join(f"{line}\n" for line in lines)


def types_in(cls: type[Message], ros1: bool = False) -> list[type[Message]]:
    """Return the types that a type is built of, each before those in it, without the primitives of ROS 1."""
    found: dict[type[Message], None] = {}
    _collect(cls, ros1, found)
    return list(found)


def _collect(cls: type[Message], ros1: bool, found: dict[type[Message], None]) -> None:
    for member in members(cls, ros1):
        kind = member.message
        if kind is not None and kind not in found and not (ros1 and kind.TYPE in ROS1_PRIMITIVES):
            found[kind] = None
            _collect(kind, ros1, found)


def short_name(cls: type[Message]) -> str:
    """Return the name of a type as definitions have it: ``geometry_msgs/Twist``; that of a service in full."""
    return cls.TYPE.replace("/msg/", "/")


def element_name(member: Member, ros1: bool = False) -> str:
    """Return the name of the type of a field, without the brackets of an array."""
    kind = member.message
    if kind is None:
        return member.primitive
    return ROS1_PRIMITIVES[kind.TYPE] if ros1 and kind.TYPE in ROS1_PRIMITIVES else short_name(kind)


def _brackets(member: Member) -> str:
    return "[]" if member.sequence else f"[{member.length}]" if member.length else ""
