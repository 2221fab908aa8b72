"""Values from outside, held against the type that they must have: every mistake becomes one sentence."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from vlatool.errors import BundleError, SpecError, nearest

STRANGE = re.compile(r'[\x00-\x1f\x7f\\:*?"<>|\ud800-\udfff]')
"""Characters that no file of a bundle has in its name: they mean something else on some system or in some engine."""
WHOLE = 2**63
Kind = type[BundleError] | type[SpecError]
"""Classes of errors whose own remedy helps with every mistake in such a value."""
LONG = 120


def shown(value: Any) -> str:
    """Return a short form of a value for a message; it may be as large and as deep as the input that it came from."""
    if isinstance(value, str | int | float | bool) or value is None:
        text = repr(value) if not isinstance(value, int) or value.bit_length() < 256 else "a number of many digits"
    else:
        text = f"{type(value).__name__} of {len(value)}" if isinstance(value, list | tuple | Mapping) else "something"
        simple = isinstance(value, list | tuple) and all(isinstance(item, str | int | float) for item in value[:9])
        text = repr(list(value[:9])) if simple and len(value) < 10 else text
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= LONG else f"{text[:LONG]}..."


def mapping(value: Any, where: str, error: Kind) -> dict[str, Any]:
    """Return a mapping whose keys are text.

    Raises:
        BundleError, SpecError: as given.
    """
    if not isinstance(value, Mapping):
        raise error(f"{where} must be a mapping; got {shown(value)}.")
    for key in value:
        text(key, f"A key of {where}", error)
    return dict(value)


def known(value: Mapping[str, Any], keys: Iterable[str], where: str, error: Kind) -> None:
    """Refuse a key that has no meaning."""
    keys = list(keys)
    for key in value:
        if key not in keys:
            hint = nearest(key if isinstance(key, str) else shown(key), keys)
            raise error(f"{where} has the unknown key {shown(key)}; {hint}.")


def text(value: Any, where: str, error: Kind, *, empty: bool = True) -> str:
    """Return text that can be written as UTF-8."""
    if not isinstance(value, str) or not (value or empty):
        raise error(f"{where} must be text{'' if empty else ' that is not empty'}; got {shown(value)}.")
    if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise error(f"{where} must be text; got half of a character: {shown(value)}.")
    return value


def whole(value: Any, where: str, error: Kind, low: int = 0) -> int:
    """Return a whole number from ``low``; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value < WHOLE:
        raise error(f"{where} must be a whole number from {low}; got {shown(value)}.")
    return value


def finite(value: Any, where: str, error: Kind) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
        raise error(f"{where} must be a number; got {shown(value)}.")
    return float(value)


def listed(value: Any, where: str, error: Kind) -> list[Any]:
    """Return a list."""
    if not isinstance(value, list | tuple):
        raise error(f"{where} must be a list; got {shown(value)}.")
    return list(value)


def axes(value: Any, where: str, error: Kind) -> int:
    """Return the number of elements of a shape: a list of whole numbers from 1."""
    axes = [whole(axis, f"An axis of {where}", error, 1) for axis in listed(value, where, error)]
    if not axes:
        raise error(f"{where} must have an axis.")
    return math.prod(axes)


def outside(path: Any) -> str:
    """Say why a path does not name a file inside a bundle, or nothing when it does.

    Example:
        >>> outside("graphs/main.onnx")
        ''
        >>> outside("../main.onnx")
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
    if STRANGE.search(path):
        return "it has characters that no file of a bundle has"
    if len(path) > 1024 or any(len(part.encode()) > 255 for part in parts):
        return "it is too long"
    return ""
