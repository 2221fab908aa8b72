"""What a target says is checked before it is used (types, depth, numbers), and is printable from there on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from vlatool.errors import TargetError
from vlatool.files.printable import one_line, printable

DEEPEST = 32
LARGEST = 1e18
"""Largest number that a measurement can be; bytes and nanoseconds of a day are far below."""
FACTS: dict[str, type | tuple[type, ...]] = {
    "command": str, "version": list, "packages": dict, "errors": dict, "architecture": str, "kernel": str,
    "free": (int, type(None)),
}  # fmt: skip


def parsed(text: bytes | str, target: str) -> dict[str, Any]:
    """Return a message of the target.

    Raises:
        TargetError: when it is no mapping of plain values with finite numbers.
    """
    try:
        found = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise nonsense(target, one_line(str(error), 200)) from error
    if not isinstance(found, dict):
        raise nonsense(target, f"a message is a {type(found).__name__}")
    checked: dict[str, Any] = sane(found, target)
    return checked


def sane(value: Any, target: str, depth: int = 0) -> Any:
    """Return a value with printable texts.

    Raises:
        TargetError: when it is nested too deep, or holds a number that is not finite or too large.
    """
    if depth > DEEPEST:
        raise nonsense(target, f"a message has more than {DEEPEST} levels")
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, (int, float)) and not (math.isfinite(value) and abs(value) <= LARGEST):
        raise nonsense(target, "a number is too large")
    if isinstance(value, list):
        return [sane(each, target, depth + 1) for each in value]
    if isinstance(value, dict):
        return {printable(name): sane(each, target, depth + 1) for name, each in value.items()}
    return value


def facts_of(heard: Mapping[str, Any], target: str) -> dict[str, Any]:
    """Return what the target says of a Python; empty when the message is of something else.

    Raises:
        TargetError: when something of it is missing or of another type.
    """
    if "python" not in heard:
        return {}
    found = heard["python"]
    if not isinstance(found, dict):
        raise nonsense(target, "the facts of a Python are no mapping")
    for name, kind in FACTS.items():
        if not isinstance(found.get(name), kind) or isinstance(found.get(name), bool):
            raise nonsense(target, f"'{name}' of a Python is {one_line(repr(found.get(name)), 80)}")
    if len(found["version"]) != 3 or not all(type(each) is int for each in found["version"]):
        raise nonsense(target, f"the version of a Python is {one_line(repr(found['version']), 80)}")
    if not all(isinstance(each, str) for each in (*found["packages"].values(), *found["errors"].values())):
        raise nonsense(target, "a package of a Python is no text")
    told = {name: one_line(value) if isinstance(value, str) else value for name, value in found.items()}
    return {**told, **{name: _lines(found[name]) for name in ("packages", "errors")}}


def _lines(texts: Mapping[str, str]) -> dict[str, str]:
    return {one_line(name, 80): one_line(text) for name, text in list(texts.items())[:64]}


def text_of(heard: Mapping[str, Any], name: str, target: str) -> str:
    """Return a text of a message.

    Raises:
        TargetError: when there is none.
    """
    if not isinstance(heard.get(name), str):
        raise nonsense(target, f"'{name}' is {one_line(repr(heard.get(name)), 80)}, no text")
    return str(heard[name])


def number_of(heard: Mapping[str, Any], name: str, target: str) -> int:
    """Return a whole number of a message.

    Raises:
        TargetError: when there is none.
    """
    if type(heard.get(name)) is not int:
        raise nonsense(target, f"'{name}' is {one_line(repr(heard.get(name)), 80)}, no whole number")
    return int(heard[name])


def nonsense(target: str, what: str) -> TargetError:
    """Return the error for a target that does not say what vlatool's own program there would."""
    return TargetError(
        f"What {target} answered makes no sense: {what}.",
        "look at that machine: what its login shell prints and runs, and whether it is the one that you mean",
    )


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")
