"""Our messages as the classes that rospy takes, so that no generated messages need to be installed."""

from __future__ import annotations

import functools
import importlib
from typing import Any, cast

from vlatool.errors import BusError
from vlatool.messages import Message
from vlatool.messages.ros1 import decode, definition, encode_parts, md5sum, service_md5sum, service_name, type_name


def carrier(kind: type[Message]) -> Any:
    """Return a subclass of genpy's ``Message`` that carries messages of a type in ROS 1's encoding.

    Its instances hold the message as ``content``; None when what was received is malformed.
    """
    return _carrier(cast(Any, kind))  # for mypy, no message class is hashable


@functools.cache
def _carrier(kind: Any) -> Any:
    genpy: Any = importlib.import_module("genpy")  # part of ROS 1

    def initialize(self: Any, content: Message | None = None) -> None:
        self.content = kind() if content is None else content

    def serialize(self: Any, buffer: Any) -> None:
        for part in encode_parts(self.content):
            buffer.write(part)

    def deserialize(self: Any, content: bytes) -> Any:
        try:
            self.content = decode(kind, content)
        except BusError:
            self.content = None
        return self

    described = {"_type": type_name(kind), "_md5sum": md5sum(kind), "_full_text": definition(kind)}
    layout = {"_has_header": False, "__slots__": ["content"], "_slot_types": []}
    methods = {"__init__": initialize, "serialize": serialize, "deserialize": deserialize}
    return type(kind.__name__, (genpy.Message,), {**described, **layout, **methods})


def service_class(request: type[Message], response: type[Message]) -> Any:
    """Return the class of a service that rospy takes."""
    described = {"_type": service_name(request), "_md5sum": service_md5sum(request, response)}
    classes = {"_request_class": carrier(request), "_response_class": carrier(response)}
    return type(described["_type"].rpartition("/")[2], (object,), {**described, **classes})
