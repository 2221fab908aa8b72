"""Hashes of message types as ROS 2 has them since Iron: RIHS01 (REP-2016), SHA-256 of a description in JSON."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from vlatool.messages._members import Member, cache, members
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.definition import types_in
from vlatool.messages.schema import Message

MESSAGE_ID = 1
PRIMITIVE_IDS = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9, "float32": 10,
    "float64": 11, "bool": 15, "byte": 16, "string": 17,
}  # fmt: skip
"""Primitive -> its number in ``type_description_interfaces/msg/FieldType``."""
ARRAY, BOUNDED_SEQUENCE, SEQUENCE = 48, 96, 144
"""What is added to the number of an element's type."""
SERVICE_EVENT = "service_msgs/msg/ServiceEventInfo"


@cache
def rihs01(cls: type[Message]) -> str:
    """Return the hash of a type: ``RIHS01_`` and 64 hexadecimal digits."""
    return _digest(_description(cls), [_description(kind) for kind in types_in(cls)])


@cache
def service_rihs01(request: type[Message], response: type[Message]) -> str:
    """Return the hash of a service: of a type with its request, its response, and the event for introspection."""
    name = request.TYPE.rpartition("_")[0]
    event = _type(f"{name}_Event", [
        _field("info", MESSAGE_ID, nested=SERVICE_EVENT),
        _field("request", BOUNDED_SEQUENCE + MESSAGE_ID, 1, request.TYPE),
        _field("response", BOUNDED_SEQUENCE + MESSAGE_ID, 1, response.TYPE),
    ])  # fmt: skip
    info = _type(SERVICE_EVENT, [
        _field("event_type", PRIMITIVE_IDS["uint8"]),
        _field("stamp", MESSAGE_ID, nested=Time.TYPE),
        _field("client_gid", ARRAY + PRIMITIVE_IDS["uint8"], 16),  # char in the .msg, which is uint8 in IDL
        _field("sequence_number", PRIMITIVE_IDS["int64"]),
    ])  # fmt: skip
    service = _type(name, [
        _field("request_message", MESSAGE_ID, nested=request.TYPE),
        _field("response_message", MESSAGE_ID, nested=response.TYPE),
        _field("event_message", MESSAGE_ID, nested=f"{name}_Event"),
    ])  # fmt: skip
    kinds = {kind for top in (request, response) for kind in (top, *types_in(top))} | {Time}
    return _digest(service, [event, info, *map(_description, kinds)])


def _digest(described: dict[str, Any], referenced: list[dict[str, Any]]) -> str:
    ordered = sorted(referenced, key=lambda entry: entry["type_name"])
    text = json.dumps({"type_description": described, "referenced_type_descriptions": ordered})
    return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


def _description(cls: type[Message]) -> dict[str, Any]:
    empty = [_field("structure_needs_at_least_one_member", PRIMITIVE_IDS["uint8"])]
    return _type(cls.TYPE, [_described(member) for member in members(cls)] or empty)


def _described(member: Member) -> dict[str, Any]:
    number = PRIMITIVE_IDS[member.primitive] if member.message is None else MESSAGE_ID
    shape = SEQUENCE if member.sequence else ARRAY if member.length else 0
    return _field(member.name, shape + number, member.length, member.message.TYPE if member.message else "")


def _type(name: str, fields: list[dict[str, Any]]) -> dict[str, Any]:
    return {"type_name": name, "fields": fields}


def _field(name: str, number: int, capacity: int = 0, nested: str = "") -> dict[str, Any]:
    kind = {"type_id": number, "capacity": capacity, "string_capacity": 0, "nested_type_name": nested}
    return {"name": name, "type": kind}
