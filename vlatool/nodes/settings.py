"""Settings of controllers and worlds: the fields of a frozen dataclass, from flags or a JSON file, checked by type."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.errors import DataError, UsageError
from vlatool.files.json import read_json

MAX_BYTES = 1_000_000
"""Largest file of settings."""
WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text", Mapping: "an object"}
ARGUMENT = re.compile(r"^(\w+(?:, \w+)*): (.*)$")
"""A line of a docstring that begins the words on an argument, or on several with commas between."""


@dataclass(frozen=True)
class Setting:
    """One setting.

    Args:
        name: Name of the field.
        type: float, int, bool, str or Mapping; of a tuple, that of its elements.
        default: Its default; ``dataclasses.MISSING`` where it has none.
        many: Whether it is a tuple.
        optional: Whether it may be None.
        help: What the docstring of the class says of it.
    """

    name: str
    type: type
    default: Any
    many: bool = False
    optional: bool = False
    help: str = ""


@functools.cache
def settings_of(cls: type) -> tuple[Setting, ...]:
    """Return the settings of a controller or a world: its fields, but those with ``metadata={"setting": False}``.

    Raises:
        TypeError: for a field of a type that no flag can set, which is a mistake of its author.
    """
    hints, words = typing.get_type_hints(cls), _arguments(inspect.getdoc(cls) or "")
    found = []
    for field in dataclasses.fields(cls):
        if not field.metadata.get("setting", True) or not field.init:
            continue
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        kind, many, optional = _kind(hints[field.name], f"{cls.__name__}.{field.name}")
        found.append(Setting(field.name, kind, default, many, optional, words.get(field.name, "")))
    return tuple(found)


def _kind(annotation: Any, where: str) -> tuple[type, bool, bool]:
    """Return the type of a value, whether there are several, and whether None is one."""
    origin, arms = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        rest = [arm for arm in arms if arm is not type(None)]
        if len(rest) == 1:
            kind, many, _ = _kind(rest[0], where)
            return kind, many, True
    if origin is tuple and arms and arms[0] in (float, int, bool, str):
        return arms[0], True, False
    if annotation in (float, int, bool, str):
        return annotation, False, False
    if origin is not None and inspect.isclass(origin) and issubclass(origin, Mapping):
        return Mapping, False, False
    raise TypeError(
        f"{where} is {annotation}; a setting is a float, int, bool, str, a tuple of one of these, or a dict"
    )


def _arguments(text: str) -> dict[str, str]:
    """Return what the section Args of a docstring says of each argument, as one line."""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in text.partition("Args:\n")[2].splitlines():
        if line.strip() and not line.startswith("    "):
            break
        match = ARGUMENT.match(line[4:])
        if match:
            names = match[1].split(", ")
        elif not line.strip() or not names:
            continue
        for name in names:
            found[name] = match[2] if match else f"{found[name]} {line.strip()}"
    return {name: words.rstrip(".")[:1].lower() + words.rstrip(".")[1:] for name, words in found.items()}


def build(cls: type, values: Mapping[str, Any], where: str) -> Any:
    """Return a controller or a world with these settings.

    Args:
        cls: The class.
        values: Setting -> value, as JSON has it.
        where: Where they come from, for messages: ``vlatool run vln``.

    Raises:
        UsageError: for an unknown setting, one that is missing, or a value of another type; the class may refuse
            values by itself.
    """
    known = {setting.name: setting for setting in settings_of(cls)}
    for name in values:
        if name not in known:
            raise UsageError.unknown(f"{where} has no setting '{name}'", name, known)
    missing = [name for name, setting in known.items() if setting.default is dataclasses.MISSING and name not in values]
    if missing:
        raise UsageError(f"{where} needs the setting '{missing[0]}'.", f"pass --{missing[0].replace('_', '-')}")
    return cls(**{name: _checked(known[name], value, where) for name, value in values.items()})


def _checked(setting: Setting, value: Any, where: str) -> Any:
    """Return a value as the field takes it: lists as tuples, whole numbers as floats where those are wanted."""
    if value is None and setting.optional:
        return None
    if setting.many:
        if not isinstance(value, list | tuple):
            raise _wrong(setting, value, where)
        return tuple(_one(setting, each, where) for each in value)
    return _one(setting, value, where)


def _one(setting: Setting, value: Any, where: str) -> Any:
    kind = setting.type
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value):
        return float(value)
    if kind is Mapping and isinstance(value, Mapping):
        return dict(value)
    if type(value) is not kind:
        raise _wrong(setting, value, where)
    return value


def _wrong(setting: Setting, value: Any, where: str) -> UsageError:
    allowed = f"a list, each {WORDS[setting.type]}" if setting.many else WORDS[setting.type]
    return UsageError(f"{where}: the setting '{setting.name}' is {value!r:.60}; allowed: {allowed}.",
                      f"set it to {allowed}, or leave it out")  # fmt: skip


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings in a JSON file.

    Raises:
        DataError: when it cannot be read, is too large, or is not a JSON object.
    """
    fix = 'write an object with settings by name, such as {"rate_hz": 10}'
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise DataError(f"The settings {path} cannot be read: {error.strerror}.", "check the path") from None
    if len(content) > MAX_BYTES:
        raise DataError(f"The settings {path} have more than {MAX_BYTES:,} bytes.", fix)
    values = read_json(content, f"The settings {path}", DataError, fix, strict=True)
    if not isinstance(values, dict):
        raise DataError(f"The settings {path} are {type(values).__name__}, not an object.", fix)
    return values


def to_plain(entry: Any) -> dict[str, Any]:
    """Return the settings of a controller or a world as JSON has them."""
    values = {setting.name: getattr(entry, setting.name) for setting in settings_of(entry.__class__)}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
