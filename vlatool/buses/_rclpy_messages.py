"""Our messages and those of rclpy, which are classes of the installed ROS 2 packages: copied field by field."""

from __future__ import annotations

import array
import dataclasses
import functools
import importlib
from typing import Annotated, Any, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np

from vlatool.errors import BusError, MissingExtra
from vlatool.messages import Message
from vlatool.messages.schema import Elements

M = TypeVar("M", bound=Message)
OWN_PACKAGE = "vlatool_msgs"


class _Field(NamedTuple):
    """A field: its name, the class of its message or messages, the elements of its array."""

    name: str
    message: Any = None
    sequence: bool = False
    elements: Elements | None = None


@functools.cache
def _fields(kind: Any) -> tuple[_Field, ...]:
    hints = get_type_hints(kind, include_extras=True)
    return tuple(_field(entry.name, hints[entry.name]) for entry in dataclasses.fields(kind))


def _field(name: str, hint: Any) -> _Field:
    if get_origin(hint) is tuple:
        return _Field(name, get_args(hint)[0], sequence=True)
    if get_origin(hint) is Annotated:
        marker = hint.__metadata__[0]
        return _Field(name, elements=marker if isinstance(marker, Elements) else None)
    return _Field(name, hint)


def generated_class(type_name: str) -> Any:
    """Return the class of rclpy for a ROS 2 name: ``geometry_msgs/msg/Twist``, ``std_srvs/srv/SetBool_Request``.

    Raises:
        MissingExtra: when its package is not installed; names the Debian package.
    """
    package, kind, name = type_name.split("/")
    try:
        found: Any = importlib.import_module(f"{package}.{kind}")
        for part in name.split("_"):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        where = (
            f"build the package {OWN_PACKAGE}: docs/guides/buses.md"
            if package == OWN_PACKAGE
            else f"apt-get install ros-$ROS_DISTRO-{package.replace('_', '-')}, and source setup.bash of ROS 2"
        )
        raise MissingExtra(
            f"This needs {type_name} of the ROS 2 package {package}, which is not installed.", where
        ) from error
    return found


def to_ros(message: Message) -> Any:
    """Return a message as an instance of its class of rclpy.

    Raises:
        MissingExtra: when its package is not installed.
        BusError: when the installed definition lacks a field, or does not take a value.
    """
    return _fill(generated_class(message.TYPE)(), message)


def _fill(theirs: Any, message: Message) -> Any:
    for field in _fields(cast(Any, type(message))):
        value = getattr(message, field.name)
        try:
            present = getattr(theirs, field.name)
            if field.message is not None and not field.sequence:
                _fill(present, value)
                continue
            setattr(theirs, field.name, _value(field, value, present))
        except (AttributeError, AssertionError, TypeError, ValueError, OverflowError) as error:
            raise _misfit(type(message), field.name, error) from error
    return theirs


def _value(field: _Field, value: Any, present: Any) -> Any:
    """Return a value as rclpy takes it, in place of its default."""
    if field.sequence:
        return [to_ros(each) for each in value]
    if field.elements is None:
        return bytes([value]) if isinstance(present, bytes) else value  # a 'byte' is bytes of length 1 there
    if isinstance(present, np.ndarray):
        return np.asarray(value, present.dtype)
    if isinstance(present, array.array):
        content = array.array(present.typecode)
        content.frombytes(np.ascontiguousarray(value).view(np.uint8).data)
        return content
    return list(value)


def from_ros(kind: type[M], theirs: Any) -> M:
    """Return a message from its class of rclpy; large arrays are views of it.

    Raises:
        BusError: when the installed definition lacks a field.
    """
    values = {}
    for field in _fields(cast(Any, kind)):
        try:
            value = getattr(theirs, field.name)
            values[field.name] = _ours(field, value)
        except (AttributeError, TypeError, ValueError) as error:
            raise _misfit(kind, field.name, error) from error
    return kind(**values)


def _ours(field: _Field, value: Any) -> Any:
    if field.message is not None:
        parts = value if field.sequence else (value,)
        found = tuple(from_ros(field.message, each) for each in parts)
        return found if field.sequence else found[0]
    if field.elements is None:
        return value[0] if isinstance(value, bytes) else value
    if field.elements.name == "string":
        return tuple(value)
    return np.asarray(value, np.dtype("uint8" if field.elements.name == "byte" else field.elements.name))


def _misfit(kind: type[Message], name: str, error: Exception) -> BusError:
    reason = " ".join(str(error).split())[:120].rstrip(".")
    return BusError(
        f"The field '{name}' of {kind.TYPE} does not fit the installed ROS 2 package: {reason}.",
        "send a value that ROS 2 takes, or install the release of that package that this definition is from",
    )
