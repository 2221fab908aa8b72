"""Frozen dataclasses as JSON values and back, with each field checked against its type: messages between processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from vlatool.files.validate import short_repr

T = TypeVar("T")
NAMES = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}


def to_json(value: Any) -> Any:
    """Return a value as JSON: a dataclass as a mapping of its fields, tuples as lists."""
    if is_dataclass(value):
        return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return list(value) if _are_numbers(value) else [to_json(item) for item in value]
    return value


def from_json(kind: type[T], value: Any, where: str = "message") -> T:
    """Return the object of a type that ``to_json`` turned into JSON: a dataclass, or a value that a field may have.

    Fields are text, numbers, truth values, tuples, mappings by text, further dataclasses, any of these or None, and
    ``Any``, which is not checked.

    Args:
        where: name of the value, for the reason.

    Raises:
        ValueError: with a short reason, when the value is not of that type, lacks a field, or has an unknown one.
    """
    try:
        return _read(kind, value, where)  # type: ignore[no-any-return]
    except OverflowError:
        raise ValueError(f"'{where}' has a number that is too large") from None


def _read(kind: Any, value: Any, where: str) -> Any:
    if kind is Any:
        return value
    if is_dataclass(kind):
        return _dataclass(kind, value, where)
    origin, inside = get_origin(kind), get_args(kind)
    if NoneType in inside:
        (other,) = (each for each in inside if each is not NoneType)
        return None if value is None else _read(other, value, where)
    if origin is tuple:
        return _tuple(inside, value, where)
    if origin is not None:  # a mapping
        items = _mapping(value, where).items()
        return {name: _read(inside[1], item, f"{where}.{name}") for name, item in items}
    if type(value) is kind or (kind is float and type(value) is int):
        return kind(value)
    raise ValueError(f"'{where}' is {short_repr(value)}, not {NAMES[kind]}")


def _dataclass(kind: Any, value: Any, where: str) -> Any:
    types = _types(kind)
    for name in _mapping(value, where):
        if name not in types:
            raise ValueError(f"'{where}' has the unknown field {short_repr(name)}")
    for field in fields(kind):
        if field.name not in value and field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"'{where}' lacks '{field.name}'")
    return kind(**{name: _read(types[name], item, f"{where}.{name}") for name, item in value.items()})


@cache
def _types(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise ValueError(f"'{where}' is {short_repr(value)}, not a mapping")
    return value


def _tuple(inside: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ValueError(f"'{where}' is {short_repr(value)}, not a list")
    if inside == (float, ...) and _are_numbers(value):
        return tuple(map(float, value))
    if inside[-1] is not ... and len(value) != len(inside):
        raise ValueError(f"'{where}' has {len(value)} values, not {len(inside)}")
    kinds = inside[:1] * len(value) if inside[-1] is ... else inside
    return tuple(_read(kinds[index], item, f"{where}[{index}]") for index, item in enumerate(value))


def _are_numbers(values: list[Any] | tuple[Any, ...]) -> bool:
    """Return whether all are numbers; long lists of timings are then not converted one by one."""
    return set(map(type, values)) <= {int, float}
