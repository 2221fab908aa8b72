"""Changes to nested mappings and lists, for tests that damage a file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def put(*path: Any) -> Callable[[Any], None]:
    """Set the value at a path to the last argument."""

    def change(data: Any) -> None:
        *where, last, value = path
        for key in where:
            data = data[key]
        data[last] = value

    return change


def take(*path: Any) -> Callable[[Any], None]:
    """Take the value at a path away."""

    def change(data: Any) -> None:
        *where, last = path
        for key in where:
            data = data[key]
        del data[last]

    return change
