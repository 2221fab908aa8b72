"""Messages of openpi's websocket protocol: MessagePack with arrays, and nothing that could be executed.

An array is ``{b"__ndarray__": True, b"data", b"dtype", b"shape"}``, a scalar of NumPy ``{b"__npgeneric__": True,
b"data", b"dtype"}``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.errors import DataError, require
from vlatool.files.array_bytes import DTYPE, array_of, short_reason
from vlatool.files.limits import check_limit
from vlatool.files.validate import short_repr

EXTRA = "remote"
MAX_ITEMS = 16_384
"""Elements of a list and entries of a mapping in a message; arrays do not count. Lists are allocated before they
are read, at each of up to 1,024 levels."""
MAX_DEPTH = 4
"""Mappings in each other that the name of a value is made of."""
ARRAY, SCALAR = b"__ndarray__", b"__npgeneric__"
KINDS = "biufU"


def pack(message: Any) -> bytes:
    """Return a message as bytes.

    Raises:
        DataError: when something in it cannot be sent.
    """
    return encode_message(message, _encode)


def unpack(data: Any) -> dict[str, Any]:
    """Return the mapping that a message holds; its arrays share the memory of its bytes and are read-only.

    Raises:
        DataError: when it is something else, too large, or holds something else than plain values and arrays.
    """
    return decode_message(data, _decode)


def encode_message(message: Any, encode: Callable[[Any], Any]) -> bytes:
    """Return a message in MessagePack, with ``encode`` for what it has no type for; raises DataError."""
    try:
        return bytes(_msgpack().packb(message, default=encode))
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"The message cannot be sent: {short_reason(error)}.", "send arrays, numbers and text"
        ) from None


def decode_message(data: Any, decode: Callable[[dict[Any, Any]], Any]) -> dict[str, Any]:
    """Return the mapping that a message in MessagePack holds, each mapping in it as ``decode`` returns it.

    Raises:
        DataError: as ``unpack`` does.
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise DataError(f"The message is {type(data).__name__}; allowed: bytes in MessagePack.", "send a binary frame")
    check_limit("message_bytes", len(data), "The message", DataError)
    try:
        value = _msgpack().unpackb(
            data, object_hook=decode, raw=False, strict_map_key=True, max_ext_len=0,
            max_array_len=MAX_ITEMS, max_map_len=MAX_ITEMS,
        )  # fmt: skip
    except DataError:
        raise
    except Exception as error:  # the seam: what the library raises for damaged bytes differs between its two forms
        reason = short_reason(error)
        raise DataError(f"The message is not MessagePack: {reason}.", "send what the protocol describes") from None
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise DataError(f"The message is a {type(value).__name__}; allowed: a mapping of names to values.",
                        "send an observation: names with their values")  # fmt: skip
    return value


def flat(values: Mapping[Any, Any], prefix: str = "", depth: int = MAX_DEPTH) -> dict[str, Any]:
    """Return values by name, of mappings within by ``NAME.NAME``.

    Raises:
        DataError: when mappings lie deeper in each other than ``depth``.

    Example:
        >>> flat({"state": 1, "images": {"top": 2}})
        {'state': 1, 'images.top': 2}
    """
    if not depth:
        raise DataError(f"The observation has more than {MAX_DEPTH} mappings in each other.", "send names with values")
    found: dict[str, Any] = {}
    for name, value in values.items():
        part = flat(value, f"{prefix}{name}.", depth - 1) if isinstance(value, Mapping) else {f"{prefix}{name}": value}
        found.update(part)
    return found


@functools.cache
def _msgpack() -> Any:
    return require("msgpack", EXTRA)


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in KINDS:
        raise TypeError(f"it holds {value.dtype}")
    if isinstance(value, np.ndarray):
        return {ARRAY: True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {SCALAR: True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"it holds a {type(value).__name__}")


def _decode(value: dict[Any, Any]) -> Any:
    if ARRAY in value:
        return array_of(value.get(b"dtype"), value.get(b"shape"), value.get(b"data"))
    if SCALAR in value:
        return _scalar(value.get(b"dtype"), value.get(b"data"))
    if any(isinstance(key, bytes) for key in value):
        raise DataError("A mapping in the message has a name that is bytes; allowed: text.", "send names as text")
    return value


def _scalar(descr: Any, value: Any) -> Any:
    """Return a scalar of NumPy; raises DataError where the value is none of its dtype."""
    known = isinstance(descr, str) and DTYPE.fullmatch(descr)
    if not known or not isinstance(value, str | bool | int | float):
        raise DataError(f"A scalar of {short_repr(descr)} is {type(value).__name__}.", "send a number or text")
    try:
        return np.dtype(descr).type(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"A scalar of {descr} cannot be read: {short_reason(error)}.", "send a number") from None
