"""Whether an ONNX graph holds tensors of a type that needs other options: its bytes are walked, as for files."""

from __future__ import annotations

import os
from pathlib import Path

from vlatool.runtime.external_data import LENGTH, SMALL, VARINT, OpenFile, messages, varint

FLOAT8 = (17, 18, 19, 20)
"""``TensorProto.DataType``: E4M3FN, E4M3FNUZ, E5M2, E5M2FNUZ."""
DATA_TYPE = 2
"""Number of the field ``TensorProto.data_type``."""
MARKS = tuple(bytes([DATA_TYPE << 3 | VARINT, code]) for code in FLOAT8)
"""How such a field begins: a message without these bytes holds no float8 tensor."""


def has_float8(model: Path | bytes) -> bool:
    """Return whether a serialized ``ModelProto``, or the file of one, holds a float8 tensor anywhere.

    A zero point in float8 is such a tensor, so that every QuantizeLinear to float8 is found (but for one whose type is
    an attribute alone, opset 21).

    Raises:
        GraphError: for bytes that are not such a message, are deeper than the limit ``graph_depth`` or have more parts
            than ``graph_fields``.
        OSError: when there is no such file.

    Example:
        >>> has_float8(b"")
        False
    """
    if isinstance(model, bytes):
        return _holds(model)
    handle = os.open(model, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return _holds(OpenFile(handle))
    finally:
        os.close(handle)


def _holds(model: bytes | OpenFile) -> bool:
    tensors = (place for message, *place in messages(model, _may_hold) if message == "TensorProto")
    return any(_data_type(model[start : min(end, start + SMALL)]) in FLOAT8 for start, end in tensors)


def _may_hold(model: bytes | OpenFile, start: int, end: int) -> bool:
    """Return whether a message may have such a tensor in it: a large one may."""
    return end - start > SMALL or any(mark in model[start:end] for mark in MARKS)


def _data_type(tensor: bytes) -> int:
    """Return the type that a tensor names before its data; 0 when it names none there."""
    at = 0
    while at < len(tensor):
        tag, at = varint(tensor, at, 5)
        field, kind = tag >> 3, tag & 7
        if kind not in (VARINT, LENGTH):
            return 0
        value, at = varint(tensor, at, 10)
        if field == DATA_TYPE and kind == VARINT:
            return value
        at += value if kind == LENGTH else 0
    return 0
