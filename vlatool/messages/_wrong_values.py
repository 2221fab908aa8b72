"""What is wrong with a message that cannot be encoded: the first field whose value does not fit, and what would."""

from __future__ import annotations

import operator
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from vlatool.errors import BusError
from vlatool.messages._members import CODES, Member, members
from vlatool.messages.schema import Message


class WrongValue(ValueError):
    """A value does not fit its field; ``explain`` says which."""


def explain(message: Any, ros1: bool) -> BusError | None:
    """Return the error that names the first field whose value does not fit; None if every value does."""
    if not isinstance(message, Message) or not message.TYPE:
        return BusError(
            f"{type(message).__name__} is not a type of message.", "give a message of a class in vlatool.messages"
        )
    for path, problem, fix in _problems(message, "", ros1):
        return BusError(f"{message.TYPE}: {path} {problem}.", fix)
    return None


def _problems(message: Message, prefix: str, ros1: bool) -> Iterator[tuple[str, str, str]]:
    for member in members(type(message), ros1):
        if member.attribute:
            yield from _member_problems(getattr(message, member.attribute), prefix + member.attribute, member, ros1)


def _member_problems(value: Any, path: str, member: Member, ros1: bool) -> Iterator[tuple[str, str, str]]:
    if member.message is None and (not (member.sequence or member.length) or member.primitive != "string"):
        whole = member.sequence or member.length > 0
        problem = _array_problem(value, member) if whole else _scalar_problem(value, member.primitive)
        if problem:
            yield path, *problem
        return
    if not member.sequence:
        yield from _element_problems(value, path, member, ros1)
    elif not isinstance(value, (tuple, list)):
        yield path, f"is {_shown(value)}, not a tuple", "give a tuple, such as () or (value,)"
    else:
        for index, element in enumerate(value):
            yield from _element_problems(element, f"{path}[{index}]", member, ros1)


def _element_problems(value: Any, path: str, member: Member, ros1: bool) -> Iterator[tuple[str, str, str]]:
    if member.message is None:
        if problem := _scalar_problem(value, member.primitive):
            yield path, *problem
    elif type(value) is not member.message:
        yield path, f"is {_shown(value)}, not a {member.message.TYPE}", f"give a {member.message.__name__}"
    else:
        yield from _problems(value, f"{path}.", ros1)


def _scalar_problem(value: Any, primitive: str) -> tuple[str, str] | None:
    """Return what is wrong with a single value, and the fix."""
    if primitive == "string":
        return _string_problem(value)
    if primitive == "bool":
        good = isinstance(value, (bool, np.bool_))
        return None if good else (f"is {_shown(value)}, not a truth value", "give True or False")
    if primitive.startswith("float"):
        try:
            struct.pack(f"<{CODES[primitive]}", value)
        except (struct.error, TypeError, ValueError):
            return f"is {_shown(value)}, not a number", "give a float"
        except OverflowError:
            return f"is {_shown(value)}, beyond the range of {primitive}", "limit it; inf and NaN are allowed"
        return None
    try:
        number = operator.index(value)
    except (TypeError, ValueError):
        return f"is {_shown(value)}, not an integer", "give an int"
    limits = np.iinfo("uint8" if primitive == "byte" else primitive)
    if limits.min <= number <= limits.max:
        return None
    return f"is {_shown(value)}, out of the range of {primitive}", f"give {limits.min} to {limits.max}"


def _string_problem(value: Any) -> tuple[str, str] | None:
    if not isinstance(value, str):
        return f"is {_shown(value)}, not a string", "give a str"
    try:
        value.encode()
    except UnicodeEncodeError:
        return f"is {_shown(value)}, which UTF-8 cannot express", "leave out lone surrogates"
    return None


def _array_problem(value: Any, member: Member) -> tuple[str, str] | None:
    """Return what is wrong with an array of numbers, and the fix."""
    try:
        fit_array(value, np.dtype(member.primitive), member.length)
    except WrongValue:
        count = f" of {member.length}" if member.length else ""
        shown = f"an array {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else _shown(value)
        return (
            f"is {shown}, not a one-dimensional array{count} of {member.primitive}",
            f"give np.asarray(values, np.{member.primitive}), one-dimensional" + (count and f",{count} elements"),
        )
    return None


def fit_array(value: Any, dtype: np.dtype[Any], length: int) -> np.ndarray[Any, Any]:
    """Return a value of an array field as a contiguous (N,) array of its dtype; values are never changed.

    Bytes are taken for ``uint8``, and an array whose dtype NumPy casts safely to this one (float32 to float64).

    Args:
        length: What N must be; 0 for any.

    Raises:
        WrongValue: when it does not fit.
    """
    if dtype.itemsize == 1 and isinstance(value, (bytes, bytearray, memoryview)):
        value = np.frombuffer(value, dtype)
    if not isinstance(value, np.ndarray) or value.ndim != 1 or (length and value.shape[0] != length):
        raise WrongValue
    if value.dtype != dtype and not np.can_cast(value.dtype, dtype, "safe"):
        raise WrongValue
    return np.ascontiguousarray(value, dtype)


def _shown(value: Any) -> str:
    """Return a value as an error shows it: its type alone for what may be long."""
    kind = type(value).__name__
    short = isinstance(value, (int, float, np.generic)) or (isinstance(value, str) and len(value) <= 40)
    return f"{value!r} ({kind})" if short else "None" if value is None else f"of type {kind}"
