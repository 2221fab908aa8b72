"""Frozen dataclasses as JSON values and back: messages between processes, manifests, specs and reports.

``from_json`` checks each field against its type. A dataclass that checks its values itself, with messages of its own,
takes them from ``field_values``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from vlatool.files.printable import amount
from vlatool.files.validate import Kind, known_keys, mapping, short_repr

T = TypeVar("T")
Number = Annotated[float, "null is NaN"]
"""A number of a report: null where it is not known, and a whole number stays one."""
NAMES = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}


def to_json(value: Any, *, defaults: bool = True) -> Any:
    """Return a value as JSON: a dataclass as a mapping of its fields, tuples as lists, paths as text.

    Args:
        defaults: whether fields that have their default are written.
    """
    if is_dataclass(value):
        items = ((field, getattr(value, field.name)) for field in fields(value))
        return {field.name: to_json(item, defaults=defaults) for field, item in items
                if defaults or item != _default(field)}  # fmt: skip
    if isinstance(value, Mapping):
        return {key: to_json(item, defaults=defaults) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return list(value) if _are_numbers(value) else [to_json(item, defaults=defaults) for item in value]
    return str(value) if isinstance(value, Path) else value


def _default(field: Field[Any]) -> Any:
    """Return the default of a field, ``MISSING`` where it has none."""
    return field.default if field.default_factory is MISSING else field.default_factory()


def field_values(kind: type, value: Any, where: str, error: Kind) -> dict[str, Any]:
    """Return the fields of a dataclass that checks its values itself; a list is a tuple where the field may be one.

    Args:
        where: name of the value, which begins the message.

    Raises:
        BundleError, SpecError: the class ``error``, when it is not a mapping or has an unknown key.
    """
    values, types = mapping(value, where, error), {field.name: str(field.type) for field in fields(kind)}
    known_keys(values, types, where, error)
    return {name: tuple(item) if isinstance(item, list) and _may_be_tuple(types[name]) else item
            for name, item in values.items()}  # fmt: skip


def _may_be_tuple(annotation: str) -> bool:
    """Return whether a type is or may be a tuple, from its text: nothing is evaluated where a robot loads a bundle."""
    return any(part.strip().startswith("tuple[") for part in annotation.split("|"))


def from_json(kind: type[T], value: Any, where: str = "message") -> T:
    """Return the object of a type that ``to_json`` turned into JSON: a dataclass, or a value that a field may have.

    Fields are text, paths, numbers, truth values, tuples, lists, mappings by text, further dataclasses, any of these or
    None, and ``Any``, which is not checked.

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
    if kind is Any or (kind == Number and type(value) is int):
        return value
    if kind == Number:
        return math.nan if value is None else _read(float, value, where)
    if is_dataclass(kind):
        return _dataclass(kind, value, where)
    origin, inside = get_origin(kind), get_args(kind)
    if NoneType in inside:
        (other,) = (each for each in inside if each is not NoneType)
        return None if value is None else _read(other, value, where)
    if origin in (tuple, list):
        return origin(_items(inside if origin is tuple else (*inside, ...), value, where))
    if origin is not None:  # a mapping
        items = _mapping(value, where).items()
        return {name: _read(inside[1], item, f"{where}.{name}") for name, item in items}
    if kind is Path:
        return Path(_read(str, value, where))
    if type(value) is kind or (kind is float and type(value) is int):
        return kind(value)
    raise ValueError(f"'{where}' is {short_repr(value)}, not {NAMES[kind]}")


def _dataclass(kind: Any, value: Any, where: str) -> Any:
    types = _types(kind)
    for name in _mapping(value, where):
        if name not in types:
            raise ValueError(f"'{where}' has the unknown field {short_repr(name)}")
    for field in fields(kind):
        if field.name not in value and _default(field) is MISSING:
            raise ValueError(f"'{where}' lacks '{field.name}'")
    return kind(**{name: _read(types[name], item, f"{where}.{name}") for name, item in value.items()})


@cache
def _types(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise ValueError(f"'{where}' is {short_repr(value)}, not a mapping")
    return value


def _items(inside: tuple[Any, ...], value: Any, where: str) -> Iterable[Any]:
    """Return the items of a list, read as the types of a tuple."""
    if not isinstance(value, list | tuple):
        raise ValueError(f"'{where}' is {short_repr(value)}, not a list")
    if inside[-1] is ... and _are_numbers(value) and inside[0] in (float, Number):
        return map(float, value) if inside[0] is float else value
    if inside[-1] is not ... and len(value) != len(inside):
        raise ValueError(f"'{where}' has {amount(len(value), 'value')}, not {len(inside)}")
    kinds = inside[:1] * len(value) if inside[-1] is ... else inside
    return [_read(kinds[index], item, f"{where}[{index}]") for index, item in enumerate(value)]


def _are_numbers(values: list[Any] | tuple[Any, ...]) -> bool:
    """Return whether all are numbers; long lists of timings are then not converted one by one."""
    return set(map(type, values)) <= {int, float}
