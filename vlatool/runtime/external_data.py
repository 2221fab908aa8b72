"""Which files beside an ONNX graph hold its weights: the graph's bytes are walked, nothing is built from them."""

from __future__ import annotations

from collections.abc import Iterator

from vlatool.errors import GraphError
from vlatool.limits import check, limit

LOCATION = b"location"
VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5
STRING_ENTRY = "StringStringEntryProto"
MESSAGES: dict[str, dict[int, str]] = {
    "ModelProto": {7: "GraphProto", 20: "TrainingInfoProto", 25: "FunctionProto"},
    "TrainingInfoProto": {1: "GraphProto", 2: "GraphProto"},
    "GraphProto": {1: "NodeProto", 5: "TensorProto", 15: "SparseTensorProto"},
    "FunctionProto": {7: "NodeProto", 11: "AttributeProto"},
    "NodeProto": {5: "AttributeProto"},
    "AttributeProto": {
        5: "TensorProto", 6: "GraphProto", 10: "TensorProto", 11: "GraphProto", 22: "SparseTensorProto",
        23: "SparseTensorProto",
    },
    "SparseTensorProto": {1: "TensorProto", 2: "TensorProto"},
    "TensorProto": {13: STRING_ENTRY},
}  # fmt: skip
"""Message -> number of a field -> message in it, as far as they lead to a tensor (onnx.proto)."""


def external_files(model: bytes) -> set[str]:
    """Return the locations of all external data that a serialized ``ModelProto`` names, as they stand there.

    Initialisers, attributes, subgraphs, functions and training graphs are gone through; time and memory are linear in
    the size of the model.

    Raises:
        GraphError: when the bytes are no such message, or are deeper than the limit ``graph_depth`` or have more parts
            than ``graph_fields``.

    Example:
        >>> external_files(b"")
        set()
    """
    if LOCATION not in model:  # the key stands in every such entry, as it is
        return set()
    found: set[str] = set()
    seen, most = 0, limit("graph_fields")
    levels = [("ModelProto", _fields(model, 0, len(model)))]
    while levels and seen <= most:
        message, fields = levels[-1]
        field, start, end = next(fields, (0, 0, 0))
        seen += 1
        if not field:
            levels.pop()
        elif (inner := MESSAGES[message].get(field)) == STRING_ENTRY:
            found |= _location(model, start, end)
        elif inner:
            levels.append((inner, _fields(model, start, end)))
            check("graph_depth", len(levels), "The graph", GraphError)
    check("graph_fields", seen, "The graph", GraphError)
    return found


def _location(model: bytes, start: int, end: int) -> set[str]:
    """Return every value of a key-value pair one of whose keys is ``location``: the last of several would win."""
    pairs = [(field, model[at:to]) for field, at, to in _fields(model, start, end)]
    if not any(field == 1 and key == LOCATION for field, key in pairs):
        return set()
    try:
        return {value.decode("utf-8") for field, value in pairs if field == 2} or {""}
    except UnicodeDecodeError:
        raise GraphError("The graph names external data by bytes that are no UTF-8.") from None


def _fields(model: bytes, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield number, start and end of the fields of a message that have a length; others are passed over."""
    while at < end:
        tag, at = _varint(model, at, end, 5)
        field, kind = tag >> 3, tag & 7
        if kind == LENGTH:
            size, at = _varint(model, at, end, 10)
            if size > end - at:
                raise GraphError("The graph is no ONNX model: a part of it is longer than the whole.")
            yield field, at, at + size
            at += size
        elif kind == VARINT:
            _, at = _varint(model, at, end, 10)
        elif kind in (FIXED32, FIXED64):
            at += 4 if kind == FIXED32 else 8
        if not field or kind not in (VARINT, FIXED32, FIXED64, LENGTH) or at > end or tag >> 32:
            raise GraphError("The graph is no ONNX model: it has a field of an unknown kind.")


def _varint(model: bytes, at: int, end: int, longest: int) -> tuple[int, int]:
    value = 0
    for number in range(longest):
        if at >= end:
            raise GraphError("The graph is no ONNX model: it ends within a number.")
        byte = model[at]
        at += 1
        value |= (byte & 0x7F) << (7 * number)
        if byte < 0x80:
            return value, at
    raise GraphError("The graph is no ONNX model: a number in it is too long.")
