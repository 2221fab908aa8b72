"""Untrusted JSON: size, depth, numbers and keys are checked; each problem is reported in one sentence."""

from __future__ import annotations

import json
import math
from typing import Any

from vlatool.errors import VlatoolError
from vlatool.files.limits import limit
from vlatool.files.validate import short_repr

MAX_DIGITS = 24


def parse_json(content: bytes, *, strict: bool = False) -> Any:
    """Parse a JSON text in UTF-8; duplicate keys are refused.

    Args:
        content: bytes of the file.
        strict: whether to refuse NaN and infinity, integers of more than ``MAX_DIGITS`` digits, lone surrogates, and
            nesting deeper than the limit ``json_depth``.

    Raises:
        ValueError: with a short reason, for any other text.
    """
    numbers: dict[str, Any] = {}
    if strict:
        numbers = {"parse_constant": _refuse_constant, "parse_int": _parse_integer, "parse_float": _parse_float}
    try:
        value = json.loads(content.decode("utf-8"), object_pairs_hook=_refuse_duplicates, **numbers)
    except RecursionError:
        raise ValueError("lists and mappings are nested too deep") from None
    except MemoryError:
        raise ValueError("it does not fit into the memory") from None
    if strict:
        _check_depth(value)
        if b"\\u" in content:
            _check_text(value)
    return value


def read_json(content: bytes, where: str, error: type[VlatoolError], fix: str, *, strict: bool = False) -> Any:
    """Parse a JSON text as ``parse_json`` does; raises ``error``, naming ``where``, when it is not valid JSON."""
    try:
        return parse_json(content, strict=strict)
    except ValueError as reason:
        raise error(f"{where} is not valid JSON: {str(reason)[:200]}.", fix) from reason


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {short_repr(twice)} occurs twice")
    return mapping


def _refuse_constant(text: str) -> Any:
    raise ValueError(f"{text} is not a number")


def _parse_integer(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _parse_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:MAX_DIGITS]} is too large")
    return value


def _check_depth(value: Any) -> None:
    """Check the depth level by level, without recursion."""
    allowed = limit("json_depth")
    level = [value]
    for _ in range(allowed + 1):
        level = [inner for item in level for inner in _containers_in(item)]
        if not level:
            return
    raise ValueError(f"more than {allowed} nested lists and mappings (the limit 'json_depth')")


def _containers_in(value: Any) -> list[Any]:
    """Return the lists and mappings directly inside a value."""
    members = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [member for member in members if isinstance(member, dict | list)]


def _check_text(value: Any) -> None:
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise ValueError("half of a character (a surrogate) in a text") from None
