"""What a message is: a frozen dataclass whose annotations are types of the ROS interface language.

Each field is annotated with one of the aliases below, with another message class, or with ``tuple[M, ...]`` of them;
a constant with ``ClassVar`` of an alias. The order of the fields is that of the ROS 2 definition. Every field has a
default, as in ROS: zero, false or empty.
Encodings (CDR, ROS 1), RIHS01 hashes and texts of definitions are derived from these classes.
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import struct
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import UsageError


@dataclass(frozen=True)
class Primitive:
    """A primitive of the ROS interface language, by its name there, such as ``float64`` or ``string``."""

    name: str


@dataclass(frozen=True)
class Elements:
    """A sequence or an array of primitives, held as a one-dimensional NumPy array or, of strings, as a tuple.

    Args:
        name: The primitive.
        length: Length of a fixed-size array; None for a sequence without a bound.
    """

    name: str
    length: int | None = None


@dataclass(frozen=True)
class Ros1Form:
    """How the ROS 1 definition of a type (Noetic) differs from that of ROS 2.

    Args:
        sequence: Whether a number ``uint32 seq`` comes first, which is written as 0 and not read.
        names: Pairs of a field and its name in ROS 1.
        absent: Fields and constants that ROS 1 lacks: they are not written, and read as their defaults.
        constants: Primitive of the constants; that of ROS 2 when empty.
    """

    sequence: bool = False
    names: tuple[tuple[str, str], ...] = ()
    absent: tuple[str, ...] = ()
    constants: str = ""


boolean = Annotated[bool, Primitive("bool")]
uint8 = Annotated[int, Primitive("uint8")]
int8 = Annotated[int, Primitive("int8")]
byte = Annotated[int, Primitive("byte")]
uint16 = Annotated[int, Primitive("uint16")]
int16 = Annotated[int, Primitive("int16")]
uint32 = Annotated[int, Primitive("uint32")]
int32 = Annotated[int, Primitive("int32")]
uint64 = Annotated[int, Primitive("uint64")]
int64 = Annotated[int, Primitive("int64")]
float32 = Annotated[float, Primitive("float32")]
float64 = Annotated[float, Primitive("float64")]
string = Annotated[str, Primitive("string")]
uint8_sequence = Annotated[NDArray[np.uint8], Elements("uint8")]
uint32_sequence = Annotated[NDArray[np.uint32], Elements("uint32")]
int32_sequence = Annotated[NDArray[np.int32], Elements("int32")]
float32_sequence = Annotated[NDArray[np.float32], Elements("float32")]
float64_sequence = Annotated[NDArray[np.float64], Elements("float64")]
string_sequence = Annotated[tuple[str, ...], Elements("string")]
float64_9 = Annotated[NDArray[np.float64], Elements("float64", 9)]
float64_12 = Annotated[NDArray[np.float64], Elements("float64", 12)]
float64_36 = Annotated[NDArray[np.float64], Elements("float64", 36)]
uint8_16 = Annotated[NDArray[np.uint8], Elements("uint8", 16)]


def zeros(dtype: str, length: int = 0) -> Any:
    """Return the default of a field that is an array: ``length`` zeros of a dtype."""
    return field(default_factory=lambda: np.zeros(length, dtype))


class Message:
    """Base of all messages; a subclass names its ROS 2 type: ``class Twist(Message, name="geometry_msgs/msg/Twist")``.

    Two messages are compared by ``same``, since their arrays have no single truth value.
    """

    TYPE: ClassVar[str] = ""
    """Name of the ROS 2 type, such as ``geometry_msgs/msg/Twist``."""
    ROS1: ClassVar[Ros1Form] = Ros1Form()
    """How the definition differs in ROS 1."""

    def __init_subclass__(cls, name: str = "", ros1: Ros1Form | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if name:
            cls.TYPE = name
            cls.ROS1 = ros1 or Ros1Form()
            _TYPES[name] = cls


_TYPES: dict[str, type[Message]] = {}


def find_type(name: str) -> type[Message]:
    """Return the class of a type by its ROS 2 name, or by its ROS 1 name (``geometry_msgs/Twist``).

    Raises:
        UsageError: for an unknown type.
    """
    package, _, rest = name.partition("/")
    if package in packages():
        importlib.import_module(f"vlatool.messages.{package}")
    full = name if "/" in rest else f"{package}/msg/{rest}"
    if full not in _TYPES:
        by_ros1_name = {ros1_name(known): known for known in _TYPES}
        full = by_ros1_name.get(name, full)
    if full not in _TYPES:
        raise UsageError.unknown(f"Unknown type of message '{name}'", full, [kind.TYPE for kind in all_types()])
    return _TYPES[full]


def ros1_name(full: str) -> str:
    """Return the ROS 1 name of a type: of a service, ``std_srvs/SetBoolRequest``."""
    package, kind, name = full.split("/")
    return f"{package}/{name if kind == 'msg' else name.replace('_', '')}"


def packages() -> list[str]:
    """Return the names of the ROS packages that have types here."""
    names = (module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]))
    return sorted(name for name in names if name.endswith(("_msgs", "_srvs", "_interfaces")))


def all_types() -> list[type[Message]]:
    """Return the classes of all types of this package, sorted by name; others may have defined more."""
    for package in packages():
        importlib.import_module(f"vlatool.messages.{package}")
    own = (_TYPES[name] for name in sorted(_TYPES))
    return [cls for cls in own if cls.__module__.startswith("vlatool.messages.")]


def same(one: Any, other: Any) -> bool:
    """Return whether two messages, or values of fields, are equal bit for bit: 0.0 is not -0.0; NaN equals NaN."""
    if isinstance(one, Message):
        return type(one) is type(other) and all(
            same(getattr(one, entry.name), getattr(other, entry.name))
            for entry in dataclasses.fields(one)  # type: ignore[arg-type]  # every subclass is a dataclass
        )
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        left, right = np.asarray(one), np.asarray(other)
        return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()
    if isinstance(one, tuple):
        return isinstance(other, tuple) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return struct.pack("d", one) == struct.pack("d", other) or (one != one and other != other)
    return bool(one == other)


def define(name: str, fields: Mapping[str, Any]) -> type[Message]:
    """Define a type that is derived from others, such as those of an action, and return its class.

    Args:
        name: ROS 2 name of the type.
        fields: Field -> its annotation: a class of messages, or an alias of this module for a number.
    """

    def fill(namespace: dict[str, Any]) -> None:
        namespace["__annotations__"] = dict(fields)
        namespace.update({field: kind() if isinstance(kind, type) else 0 for field, kind in fields.items()})

    bare = types.new_class(name.rpartition("/")[2], (Message,), {"name": name}, fill)
    return dataclass(frozen=True, eq=False)(bare)
