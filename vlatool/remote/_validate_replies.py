"""Validation of replies from a target (types, depth, numbers) before they are used; their text becomes printable."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from vlatool.errors import TargetError
from vlatool.files.messages import from_json
from vlatool.files.printable import one_line, printable

T = TypeVar("T")
MAX_DEPTH = 32
MAX_NUMBER = 1e18
"""Largest plausible number in a measurement; bytes and nanoseconds of a day are far below it."""
MAX_PACKAGES = 64


@dataclass(frozen=True)
class Python:
    """What a Python of the target says of itself.

    Args:
        command: command, as ``sh`` on the target finds it.
        version: major, minor, micro.
        packages: name -> version, of those asked for that it can import.
        errors: name -> why it cannot.
        architecture, kernel: architecture and kernel of the machine.
        free: bytes where its cache directory is; None when it cannot tell.
        managed: whether it is one that pip must not change (PEP 668).
    """

    command: str
    version: tuple[int, int, int]
    packages: dict[str, str]
    errors: dict[str, str]
    architecture: str
    kernel: str
    free: int | None
    managed: bool = False


@dataclass(frozen=True)
class AgentExit:
    """How the agent on the target ended, and the last that it logged."""

    code: int
    log: str


@dataclass(frozen=True)
class DiskFull:
    """What the target says when its disk is too full for what is sent."""

    free: int
    need: int
    path: str


def parse(text: bytes | str, target: str) -> dict[str, Any]:
    """Return a message of the target."""
    try:
        message = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise invalid_reply(target, one_line(str(error), 200)) from error
    if not isinstance(message, dict):
        raise invalid_reply(target, f"a message is a {type(message).__name__}")
    checked: dict[str, Any] = sane(message, target)
    return checked


def sane(value: Any, target: str, depth: int = 0) -> Any:
    """Return a value with printable texts."""
    if depth > MAX_DEPTH:
        raise invalid_reply(target, f"a message has more than {MAX_DEPTH} levels")
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, (int, float)) and not (math.isfinite(value) and abs(value) <= MAX_NUMBER):
        raise invalid_reply(target, "a number is too large")
    if isinstance(value, list):
        return [sane(item, target, depth + 1) for item in value]
    if isinstance(value, dict):
        return {printable(name): sane(item, target, depth + 1) for name, item in value.items()}
    return value


def read(kind: type[T], value: Any, target: str, where: str) -> T:
    """Return a reply of the target as an object of a type."""
    try:
        return from_json(kind, value, where)
    except ValueError as error:
        raise invalid_reply(target, one_line(str(error), 200)) from error


def python_of(facts: Any, target: str) -> Python:
    """Return what the target says of a Python, each text on a line of its own."""
    python = read(Python, facts, target, "python")
    return replace(
        python,
        command=one_line(python.command),
        architecture=one_line(python.architecture),
        kernel=one_line(python.kernel),
        packages=_on_one_line(python.packages),
        errors=_on_one_line(python.errors),
    )


def _on_one_line(texts: Mapping[str, str]) -> dict[str, str]:
    return {one_line(name, 80): one_line(text) for name, text in list(texts.items())[:MAX_PACKAGES]}


def invalid_reply(target: str, what: str) -> TargetError:
    """Return the error for a reply that vlatool's program on the target would not send."""
    return TargetError(
        f"Invalid reply from {target}: {what}.",
        "look at that machine: what its login shell prints and runs, and whether it is the one that you mean",
    )


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")
