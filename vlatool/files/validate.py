"""Type checks of untrusted values; each problem is reported in one sentence."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from vlatool.errors import BundleError, SpecError, suggest

FORBIDDEN_CHARACTERS = re.compile(r'[\x00-\x1f\x7f\\:*?"<>|]')
"""Characters that names of files in a bundle must not have: some system or engine gives them another meaning."""
MAX_INTEGER = 2**63
Kind = type[BundleError] | type[SpecError]
"""Classes of errors whose own remedy fits every problem with such a value."""
MAX_CHARACTERS = 120


def short_repr(value: Any) -> str:
    """Return a short form of a value of any size and depth, for a message."""
    if isinstance(value, str | int | float | bool) or value is None:
        text = repr(value) if not isinstance(value, int) or value.bit_length() < 256 else "a number of many digits"
    else:
        text = f"{type(value).__name__} of {len(value)}" if isinstance(value, list | tuple | Mapping) else "something"
        simple = isinstance(value, list | tuple) and all(isinstance(item, str | int | float) for item in value[:9])
        text = repr(list(value[:9])) if simple and len(value) < 10 else text
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= MAX_CHARACTERS else f"{text[:MAX_CHARACTERS]}..."


def has_half_character(text: str) -> bool:
    r"""Return whether a text has a surrogate, which cannot be encoded as UTF-8.

    Example:
        >>> has_half_character("\ud83d.onnx")
        True
    """
    return not text.isascii() and any("\ud800" <= letter <= "\udfff" for letter in text)


def mapping(value: Any, where: str, error: Kind) -> dict[str, Any]:
    """Return a mapping whose keys are strings; raises ``error`` otherwise."""
    if not isinstance(value, Mapping):
        raise error(f"{where} must be a mapping; got {short_repr(value)}.")
    for key in value:
        text(key, f"A key of {where}", error)
    return dict(value)


def known_keys(value: Mapping[str, Any], keys: Iterable[str], where: str, error: Kind) -> None:
    """Refuse an unknown key."""
    keys = list(keys)
    for key in value:
        if key not in keys:
            hint = suggest(key if isinstance(key, str) else short_repr(key), keys)
            raise error(f"{where} has the unknown key {short_repr(key)}; {hint}.")


def text(value: Any, where: str, error: Kind, *, empty: bool = True) -> str:
    """Return a string that can be encoded as UTF-8."""
    if not isinstance(value, str) or not (value or empty):
        raise error(f"{where} must be text{'' if empty else ' that is not empty'}; got {short_repr(value)}.")
    if has_half_character(value):
        raise error(f"{where} must be text; got half of a character: {short_repr(value)}.")
    return value


def integer(value: Any, where: str, error: Kind, low: int = 0) -> int:
    """Return an integer from ``low``; booleans are refused."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value < MAX_INTEGER:
        raise error(f"{where} must be a whole number from {low}; got {short_repr(value)}.")
    return value


def finite_number(value: Any, where: str, error: Kind) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
        raise error(f"{where} must be a number; got {short_repr(value)}.")
    return float(value)


def sequence(value: Any, where: str, error: Kind) -> list[Any]:
    """Return a list."""
    if not isinstance(value, list | tuple):
        raise error(f"{where} must be a list; got {short_repr(value)}.")
    return list(value)


def element_count(value: Any, where: str, error: Kind) -> int:
    """Return the number of elements of a shape: a list of integers from 1."""
    axes = [integer(axis, f"An axis of {where}", error, 1) for axis in sequence(value, where, error)]
    if not axes:
        raise error(f"{where} must have an axis.")
    return math.prod(axes)


MAX_NAME_BYTES = 200
"""Bytes of a name that files are called after, with endings of their own."""


def name_problem(name: Any) -> str:
    """Return why files inside a directory cannot be called after a name, or nothing when they can.

    Example:
        >>> name_problem("../../main")
        'it leaves the directory'
        >>> name_problem("graphs/main")
        'it is a path'
    """
    if problem := path_problem(name):
        return problem
    if "/" in name:
        return "it is a path"
    return "it is too long" if len(name.encode()) > MAX_NAME_BYTES else ""


def path_problem(path: Any) -> str:
    """Return why a path does not name a file inside a bundle, or nothing when it does.

    Example:
        >>> path_problem("graphs/main.onnx")
        ''
        >>> path_problem("../main.onnx")
        'it leaves the directory'
    """
    if not isinstance(path, str) or not path:
        return "it is empty" if path == "" else "it is not text"
    parts = path.split("/")
    if path.startswith("/"):
        return "it is absolute"
    if ".." in parts:
        return "it leaves the directory"
    if "" in parts or "." in parts:
        return "it has a part that is empty or a dot"
    if FORBIDDEN_CHARACTERS.search(path) or has_half_character(path):
        return "it has characters that no file of a bundle has"
    if len(path) > 1024 or any(len(part.encode()) > 255 for part in parts):
        return "it is too long"
    return ""
