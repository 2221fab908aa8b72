"""Arrays of numbers as bytes in messages of others: sizes are checked before anything is allocated."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError
from vlatool.files.npz import check_values, npy_header
from vlatool.files.printable import amount
from vlatool.files.validate import short_repr

Array = NDArray[Any]
DTYPE = re.compile(r"[<>=|]?[biufU]\d{1,9}")
"""A dtype as NumPy writes it: truth values, numbers or text; never objects, records or complex numbers."""
MAX_AXES = 16
SEND_ANOTHER = "send arrays of numbers, truth values or text, with all of their bytes"


def array_of(descr: Any, shape: Any, data: Any, *, what: str = "An array") -> Array:
    """Return the array that a dtype, a shape and bytes describe; it shares the memory of the bytes where it can.

    Args:
        descr: dtype as NumPy writes it, such as ``<f4``.
        shape: sizes of the axes.
        data: bytes of the elements in C order.
        what: name in messages.

    Raises:
        DataError: for another dtype than one of numbers, truth values or text, and bytes that do not fit the shape or
            are not values of the dtype.

    Example:
        >>> array_of("<f4", [2], bytes(8)).tolist()
        [0.0, 0.0]
    """
    if not isinstance(descr, str) or not DTYPE.fullmatch(descr):
        raise DataError(f"{what} has the dtype {short_repr(descr)}; allowed: numbers and text.", SEND_ANOTHER)
    axes = tuple(shape) if isinstance(shape, Sequence) and not isinstance(shape, str | bytes) else (None,)
    whole = all(type(axis) is int and 0 <= axis < 1 << 40 for axis in axes)
    if not whole or len(axes) > MAX_AXES or not isinstance(data, bytes | bytearray | memoryview):
        got = f"the shape {short_repr(shape)} and its data as {type(data).__name__}"
        raise DataError(f"{what} has {got}; allowed: up to {MAX_AXES} sizes, and bytes.", SEND_ANOTHER)
    try:
        dtype = np.dtype(descr)
        if not dtype.itemsize or math.prod(axes) * dtype.itemsize != len(data):
            raise ValueError(f"{dtype} {list(axes)} does not take {amount(len(data), 'byte')}")
        return check_values(np.frombuffer(data, dtype).reshape(axes), what)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{what} cannot be read: {short_reason(error)}.", SEND_ANOTHER) from None


def npy_array(content: Any, *, what: str = "An array") -> Array:
    """Return the array in the bytes of a ``.npy`` file.

    Raises:
        DataError: as ``array_of`` does, and for bytes in another format or with pickled objects.
    """
    if not isinstance(content, bytes):
        raise DataError(f"{what} is a {type(content).__name__}; allowed: the bytes of numpy.save.", SEND_ANOTHER)
    stream = io.BytesIO(content)
    try:
        shape, fortran, dtype = npy_header(stream)
    except (TypeError, ValueError) as error:
        raise DataError(f"{what} cannot be read: {short_reason(error)}.", SEND_ANOTHER) from None
    array = array_of(dtype.str, shape[::-1] if fortran else shape, content[stream.tell() :], what=what)
    return array.T if fortran else array


def npy_bytes(array: Array) -> bytes:
    """Return an array of numbers as the bytes of a ``.npy`` file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def short_reason(error: BaseException) -> str:
    """Return the first line of what an error says, without the full stop."""
    return (str(error).strip().rstrip(".").splitlines() or [type(error).__name__])[0][:200]
