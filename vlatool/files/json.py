"""JSON from outside: size, depth, numbers and keys are checked, and every mistake is one sentence."""

from __future__ import annotations

import json
import math
from typing import Any

from vlatool.errors import VlatoolError
from vlatool.files.limits import limit
from vlatool.files.typed import shown

DIGITS = 24


def parse_json(content: bytes, *, strict: bool = False) -> Any:
    """Return what a JSON text in UTF-8 says; a key that occurs twice in a mapping is refused.

    Args:
        content: The bytes of the file.
        strict: Refuse NaN and infinity, whole numbers of more digits than anything counts, halves of characters, and
            lists and mappings deeper than the limit ``json_depth``.

    Raises:
        ValueError: with a short reason, for everything that is no such text.
    """
    numbers: dict[str, Any] = {}
    if strict:
        numbers = {"parse_constant": _no_constant, "parse_int": _whole, "parse_float": _finite}
    try:
        value = json.loads(content.decode("utf-8"), object_pairs_hook=_once, **numbers)
    except RecursionError:
        raise ValueError("lists and mappings are too deep inside each other") from None
    except MemoryError:
        raise ValueError("it does not fit into the memory") from None
    if strict:
        _check_depth(value)
        if b"\\u" in content:
            _check_text(value)
    return value


def read_json(content: bytes, where: str, error: type[VlatoolError], fix: str, *, strict: bool = False) -> Any:
    """Return what a JSON text says; see ``parse_json``.

    Raises:
        VlatoolError: of the given type: ``where`` is not valid JSON.
    """
    try:
        return parse_json(content, strict=strict)
    except ValueError as reason:
        raise error(f"{where} is not valid JSON: {str(reason)[:200]}.", fix) from reason


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {shown(twice)} occurs twice")
    return mapping


def _no_constant(text: str) -> Any:
    raise ValueError(f"{text} is not a number")


def _whole(text: str) -> int:
    if len(text) > DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:DIGITS]} is too large")
    return value


def _check_depth(value: Any) -> None:
    """Go through the levels one after the other: what is too deep for a recursion is too deep for others, too."""
    allowed = limit("json_depth")
    level = [value]
    for _ in range(allowed + 1):
        level = [inner for item in level for inner in _inner(item)]
        if not level:
            return
    raise ValueError(f"more than {allowed} lists and mappings inside each other (the limit 'json_depth')")


def _inner(value: Any) -> list[Any]:
    """Return the lists and mappings directly inside a value."""
    members = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [member for member in members if isinstance(member, dict | list)]


def _check_text(value: Any) -> None:
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise ValueError("half of a character (a surrogate) in a text") from None
