"""The fields and constants of a message type, read from its class, as ROS 2 or ROS 1 defines them."""

from __future__ import annotations

import dataclasses
import functools
import struct
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

from vlatool.messages.schema import Elements, Message, Primitive

F = TypeVar("F", bound=Callable[..., Any])
CODES = {
    "bool": "?", "byte": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i",
    "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
"""Primitive of a fixed size -> its code in ``struct``."""
SIZES = {name: struct.calcsize(f"<{code}") for name, code in CODES.items()}
"""Primitive of a fixed size -> its bytes, which are its alignment in CDR, too."""


class Member(NamedTuple):
    """A field of a message type.

    Args:
        attribute: Attribute of the message; empty for what is not in it, the ``seq`` of a ROS 1 header.
        name: Name in the definition.
        primitive: Primitive, such as ``float64`` or ``string``; empty for a message.
        message: Class of a message; None for a primitive.
        sequence: Whether it is a sequence.
        length: Length of a fixed-size array; 0 for a single value or a sequence.
    """

    attribute: str
    name: str
    primitive: str = ""
    message: type[Message] | None = None
    sequence: bool = False
    length: int = 0


class Constant(NamedTuple):
    """A constant of a message type: its primitive, name and value."""

    primitive: str
    name: str
    value: Any


def cache(function: F) -> F:
    """Return ``functools.cache`` of a function, typed as the function: for mypy, no message class is hashable."""
    return cast(F, functools.cache(function))


@cache
def members(cls: type[Message], ros1: bool = False) -> tuple[Member, ...]:
    """Return the fields of a type, in order, as ROS 2 defines them or as ROS 1 does."""
    form, hints = cls.ROS1, get_type_hints(cls, include_extras=True)
    names = dict(form.names) if ros1 else {}
    found = [Member("", "seq", "uint32")] if ros1 and form.sequence else []
    every = [entry.name for entry in dataclasses.fields(cls)]  # type: ignore[arg-type]  # a subclass is a dataclass
    attributes = [name for name in every if not (ros1 and name in form.absent)]
    return (*found, *(_member(name, names.get(name, name), hints[name]) for name in attributes))


def _member(attribute: str, name: str, hint: Any) -> Member:
    if get_origin(hint) is tuple:
        return Member(attribute, name, message=get_args(hint)[0], sequence=True)
    if get_origin(hint) is not Annotated:
        return Member(attribute, name, message=hint)
    marker = hint.__metadata__[0]
    if isinstance(marker, Elements):
        return Member(attribute, name, marker.name, sequence=marker.length is None, length=marker.length or 0)
    return Member(attribute, name, cast(Primitive, marker).name)


@cache
def constants(cls: type[Message], ros1: bool = False) -> tuple[Constant, ...]:
    """Return the constants of a type, in order, as ROS 2 defines them or as ROS 1 does."""
    found = []
    for name, hint in get_type_hints(cls, include_extras=True).items():
        inner: Any = get_args(hint)[0] if get_origin(hint) is ClassVar else None
        if get_origin(inner) is not Annotated or (ros1 and name in cls.ROS1.absent):
            continue
        primitive = (cls.ROS1.constants if ros1 else "") or inner.__metadata__[0].name
        found.append(Constant(primitive, name, getattr(cls, name)))
    return tuple(found)
