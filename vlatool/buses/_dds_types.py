"""Descriptions of message types for Cyclone DDS, which it needs for discovery and to check what comes."""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

from vlatool.buses._names import dds_type
from vlatool.errors import require
from vlatool.messages import Message
from vlatool.messages.schema import Elements

EMPTY = {"structure_needs_at_least_one_member": "uint8"}
"""The member that ROS 2 gives a type without fields."""
HEADER = {"request_guid": "uint64", "request_number": "int64"}
"""What rmw_cyclonedds puts before each request and response: whose request it is, and which one."""
OCTETS = ("byte", "char")
"""Primitives that are single bytes on the wire, like uint8."""


def describe(message: type[Message]) -> Any:
    """Return the class that describes a message type to cyclonedds."""
    return _describe(cast(Any, message), False)


def describe_service_part(message: type[Message]) -> Any:
    """Return the class that describes a request or a response with the header that rmw_cyclonedds adds."""
    return _describe(cast(Any, message), True)


@functools.cache
def _describe(message: Any, header: bool) -> Any:
    idl, types = require("cyclonedds.idl", "dds"), require("cyclonedds.idl.types", "dds")
    hints = get_type_hints(message, include_extras=True)
    fields = {entry.name: _field(types, hints[entry.name]) for entry in dataclasses.fields(message)}
    fields = fields or {name: _primitive(types, kind) for name, kind in EMPTY.items()}
    if header:
        fields = {**{name: _primitive(types, kind) for name, kind in HEADER.items()}, **fields}
    name = dds_type(message.TYPE)
    return idl.make_idl_struct(name.rpartition("::")[2], name.replace("::", "."), fields)


def _field(types: Any, hint: Any) -> Any:
    if get_origin(hint) is tuple:
        return types.sequence[_describe(get_args(hint)[0], False)]
    if get_origin(hint) is not Annotated:
        return _describe(hint, False)
    marker = hint.__metadata__[0]
    element = _primitive(types, marker.name)
    if not isinstance(marker, Elements):
        return element
    return types.sequence[element] if marker.length is None else types.array[element, marker.length]


def _primitive(types: Any, name: str) -> Any:
    if name in ("string", "bool"):
        return {"string": str, "bool": bool}[name]
    return getattr(types, "uint8" if name in OCTETS else name)
