"""Which files beside an ONNX graph hold its weights: the graph's bytes are walked, nothing is built from them.

Of a file, what need not be looked at is not even read: the data of large tensors are passed over.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from vlatool.errors import GraphError
from vlatool.files.limits import check_limit, limit

COPY_AGAIN = "copy the graph again from where it was made, or make it again"

LOCATION = b"location"
VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5
HEAD = 15
"""Bytes that the tag and the length of a field take at most."""
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


SEARCH_BYTES = 16 * 1024
"""Bytes of a message up to which it is searched for the key as a whole before it is walked, and of one read."""


class OpenFile:
    """The bytes of an open file, read where they are looked at; the descriptor ``handle`` stays open."""

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._size = os.fstat(handle).st_size
        self._at, self._part = 0, b""

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, where: slice) -> bytes:
        start, end, _ = where.indices(self._size)
        if not self._at <= start <= end <= self._at + len(self._part):
            self._at, self._part = start, os.pread(self._handle, max(SEARCH_BYTES, end - start), start)
        return self._part[start - self._at : end - self._at]


def asked_of(question: Callable[[bytes | OpenFile], bool], model: Path | bytes) -> bool:
    """Return the answer to a question about a serialized ``ModelProto``, or about the file of one.

    Raises:
        GraphError: what the question raises.
        OSError: when there is no such file.
    """
    if isinstance(model, bytes):
        return question(model)
    handle = os.open(model, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return question(OpenFile(handle))
    finally:
        os.close(handle)


MayHold = Callable[[bytes | OpenFile, int, int], bool]


def external_files(model: bytes | OpenFile) -> set[str]:
    """Return the locations of all external data that a serialized ``ModelProto`` names, as written there.

    Initialisers, attributes, subgraphs, functions and training graphs are gone through, as far as the key stands in
    them. Time is linear in the number of parts, and in the size of those that name weights beside the graph.

    Raises:
        GraphError: for bytes that are not such a message, are deeper than the limit ``graph_depth`` or have more parts
            than ``graph_fields``.

    Example:
        >>> external_files(b"")
        set()
    """
    entries = (span for message, *span in messages(model, _may_name) if message == STRING_ENTRY)
    return {name for start, end in entries for name in _location(model, start, end)}


def messages(model: bytes | OpenFile, may_hold: MayHold) -> Iterator[tuple[str, int, int]]:
    """Yield what every message in a serialized ``ModelProto`` is, where it starts and where it ends (``MESSAGES``).

    Args:
        may_hold: Of the bytes and the place of a message, whether to go into it.

    Raises:
        GraphError: for bytes that are not such a message, are deeper than the limit ``graph_depth`` or have more parts
            than ``graph_fields``.
    """
    seen, most = 0, limit("graph_fields")
    levels = [("ModelProto", parts(model, 0, len(model)))] if may_hold(model, 0, len(model)) else []
    while levels and seen <= most:
        message, fields = levels[-1]
        field, start, end = next(fields, (0, 0, 0))
        seen += 1
        inner = MESSAGES[message].get(field)
        if not field:
            levels.pop()
        elif inner:
            yield inner, start, end
            if inner in MESSAGES and may_hold(model, start, end):
                levels.append((inner, parts(model, start, end)))
                check_limit("graph_depth", len(levels), "The graph", GraphError)
    check_limit("graph_fields", seen, "The graph", GraphError)


def _may_name(model: bytes | OpenFile, start: int, end: int) -> bool:
    """Return whether a message may hold the key, which stands in every such entry as it is: a large one may."""
    return end - start > SEARCH_BYTES or LOCATION in model[start:end]


def _location(model: bytes | OpenFile, start: int, end: int) -> set[str]:
    """Return every value of a key-value pair one of whose keys is ``location``: the last of several would win."""
    pairs = [(field, model[at : min(to, at + SEARCH_BYTES)]) for field, at, to in parts(model, start, end)]
    if not any(field == 1 and key == LOCATION for field, key in pairs):
        return set()
    try:
        return {value.decode("utf-8") for field, value in pairs if field == 2} or {""}
    except UnicodeDecodeError:
        raise GraphError("The graph names external data by bytes that are not UTF-8.", COPY_AGAIN) from None


def parts(model: bytes | OpenFile, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield number, start and end of the fields of a message that have a length; others are passed over."""
    return ((field, start, to) for field, start, to, number in fields(model, at, end) if number < 0)


def fields(model: bytes | OpenFile, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield number, start, end and value of the fields of a message.

    A number has its value, and an empty extent; a field with a length has its extent, and -1. Numbers of fixed size,
    which ONNX uses for floats alone, are passed over.
    """
    while at < end:
        head = model[at : min(end, at + HEAD)]
        tag, used = varint(head, 0, 5)
        field, kind = tag >> 3, tag & 7
        if not field or kind not in (VARINT, FIXED32, FIXED64, LENGTH) or tag >> 32:
            raise GraphError("The graph is not an ONNX model: it has a field of an unknown kind.", COPY_AGAIN)
        if kind == LENGTH:
            size, used = varint(head, used, 10)
            at += used
            if size > end - at:
                raise GraphError("The graph is not an ONNX model: a part of it is longer than the whole.", COPY_AGAIN)
            yield field, at, at + size, -1
            at += size
        elif kind == VARINT:
            number, used = varint(head, used, 10)
            at += used
            yield field, at, at, number
        else:
            at += used + (4 if kind == FIXED32 else 8)
        if at > end:
            raise GraphError("The graph is not an ONNX model: it has a field of an unknown kind.", COPY_AGAIN)


def varint(head: bytes, at: int, longest: int) -> tuple[int, int]:
    """Return a number of at most ``longest`` bytes, and where it ends."""
    value = 0
    for number in range(longest):
        if at >= len(head):
            raise GraphError("The graph is not an ONNX model: it ends within a number.", COPY_AGAIN)
        byte = head[at]
        at += 1
        value |= (byte & 0x7F) << (7 * number)
        if byte < 0x80:
            return value, at
    raise GraphError("The graph is not an ONNX model: a number in it is too long.", COPY_AGAIN)
