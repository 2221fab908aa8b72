"""Whether an ONNX graph holds tensors or nodes that need other options: its bytes are walked, as for files."""

from __future__ import annotations

import functools
from pathlib import Path

from vlatool.runtime.external_data import SEARCH_BYTES, VARINT, OpenFile, asked_of, fields, messages, parts

FLOAT8 = (17, 18, 19, 20)
"""``TensorProto.DataType``: E4M3FN, E4M3FNUZ, E5M2, E5M2FNUZ."""
DATA_TYPE = 2
"""Number of the field ``TensorProto.data_type``."""
FLOAT16, INT8 = (10,), (2, 3)
"""``TensorProto.DataType``: FLOAT16; UINT8 and INT8."""
NODE_INPUT, NODE_TYPE = 1, 4
"""Numbers of the fields ``NodeProto.input`` and ``NodeProto.op_type``."""
WITH_ZERO_POINT = {
    b"MatMulInteger": 4, b"DequantizeLinear": 3, b"MatMulIntegerToFloat": 6, b"DynamicQuantizeMatMul": 4, b"QGemm": 6,
    b"QAttention": 8, b"DynamicQuantizeLSTM": 12,
}  # fmt: skip
"""Operator -> how many inputs it has where its weights have a zero point."""


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
    return holds_type(FLOAT8, model)


def holds_type(codes: tuple[int, ...], model: Path | bytes) -> bool:
    """Return whether a serialized ``ModelProto``, or the file of one, holds a tensor of one of these types anywhere.

    Args:
        codes: Numbers of ``TensorProto.DataType`` below 128.

    Raises:
        GraphError, OSError: as ``has_float8``.
    """
    return asked_of(functools.partial(_holds, codes), model)


def lacks_zero_point(model: Path | bytes) -> bool:
    """Return whether a node of a serialized ``ModelProto``, or of its file, has int8 weights without a zero point.

    Types are not looked at: weights and values of other types may be found, too.

    Raises:
        GraphError, OSError: as ``has_float8``.

    Example:
        >>> lacks_zero_point(b"")
        False
    """
    return asked_of(_lacks, model)


def _lacks(model: bytes | OpenFile) -> bool:
    nodes = (span for message, *span in messages(model, _may_compute) if message == "NodeProto")
    return any(_short(model, start, end) for start, end in nodes)


def _may_compute(model: bytes | OpenFile, start: int, end: int) -> bool:
    """Return whether a message may have such a node in it: a large one may."""
    return end - start > SEARCH_BYTES or any(name in model[start:end] for name in WITH_ZERO_POINT)


def _short(model: bytes | OpenFile, start: int, end: int) -> bool:
    inputs, kind = 0, b""
    for field, at, to in parts(model, start, end):
        inputs += field == NODE_INPUT and to > at
        if field == NODE_TYPE:
            kind = model[at : min(to, at + SEARCH_BYTES)]
    return inputs < WITH_ZERO_POINT.get(kind, 0)


def _holds(codes: tuple[int, ...], model: bytes | OpenFile) -> bool:
    marks = [bytes([DATA_TYPE << 3 | VARINT, code]) for code in codes]  # how such a field begins

    def may_hold(content: bytes | OpenFile, start: int, end: int) -> bool:
        return end - start > SEARCH_BYTES or any(map(content[start:end].__contains__, marks))

    tensors = (span for message, *span in messages(model, may_hold) if message == "TensorProto")
    return any(_data_type(model, start, end) in codes for start, end in tensors)


def _data_type(model: bytes | OpenFile, start: int, end: int) -> int:
    """Return the type that a tensor names, most often before its data; 0 when it names none."""
    return next((number for field, _, _, number in fields(model, start, end) if field == DATA_TYPE), 0)
