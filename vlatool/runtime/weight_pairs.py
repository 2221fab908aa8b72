"""Whether every int8 weight of an ONNX graph is one that cannot saturate (``weights.pairs``): its bytes are walked.

What the file says of itself would not do: an engine that skips its exact mode for such a graph computes something else
when one weight is not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vlatool.errors import GraphError
from vlatool.runtime.external_data import OpenFile, asked_of, fields, messages, varint
from vlatool.weights import pairs

INT8 = 3
"""``TensorProto.DataType``."""
DIMS, DATA_TYPE, TENSOR_NAME, RAW_DATA = 1, 2, 8, 9
"""Numbers of fields of ``TensorProto`` (onnx.proto)."""
INPUT, OUTPUT, OPERATOR, ATTRIBUTE = 1, 2, 4, 5
"""Those of ``NodeProto``."""
ATTRIBUTE_NAME, INTEGER = 1, 3
"""Those of ``AttributeProto``."""
WEIGHT_INPUT = {
    "MatMul": 1, "Gemm": 1, "Conv": 1, "MatMulInteger": 1, "MatMulIntegerToFloat": 1, "DynamicQuantizeMatMul": 1,
    "QLinearMatMul": 3, "QLinearConv": 3, "QGemm": 3,
}  # fmt: skip
"""Operator -> which input its weight is."""
LOOKS_UP = ("Gather", "GatherND", "GatherElements")
"""Operators that read rows of a weight and multiply nothing."""


@dataclass(frozen=True)
class _Node:
    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    transposed: bool


@dataclass(frozen=True)
class _Weight:
    shape: tuple[int, ...]
    start: int
    end: int


def weights_fit(model: Path | bytes) -> bool:
    """Return whether no product of uint8 activations with a stored int8 weight saturates, whatever the activations are.

    False where that cannot be told: weights beside the graph, two of one name, or readers that are not known.

    Args:
        model: A serialized ``ModelProto``, or the file of one.

    Raises:
        GraphError: for bytes that are not such a message, are deeper than the limit ``graph_depth`` or have more parts
            than ``graph_fields``.
        OSError: when there is no such file.
    """
    return asked_of(_fit, model)


def _fit(model: bytes | OpenFile) -> bool:
    nodes: list[_Node] = []
    weights: dict[str, _Weight] = {}
    for message, start, end in messages(model, lambda *_: True):
        if message == "NodeProto":
            nodes.append(_node(model, start, end))
        elif message == "TensorProto":
            name, weight = _tensor(model, start, end)
            if weight is not None and weights.setdefault(name, weight) is not weight:
                return False
    # what a vector may be multiplied by, as it is or behind the first input of any other operator
    multiplied = {
        node.inputs[index] for node in nodes if (index := WEIGHT_INPUT.get(node.operator, 0)) < len(node.inputs)
    }
    vectors = {name for name, weight in weights.items() if len(weight.shape) < 2}  # zero points, as a rule
    matrices = {name: weight for name, weight in weights.items() if name not in vectors}
    return (
        bool(matrices)
        and not vectors & multiplied
        and all(_met(model, name, weight, nodes) for name, weight in matrices.items())
    )


def _met(model: bytes | OpenFile, name: str, weight: _Weight, nodes: list[_Node]) -> bool:
    """Return whether all readers of a weight are known, and none of them saturates with it."""
    if weight.end - weight.start != math.prod(weight.shape):
        return False
    readers = list(_readers(name, nodes))
    values = np.frombuffer(model[weight.start : weight.end], np.int8).reshape(weight.shape)
    orders = {_order(node, names, len(weight.shape)) for node, names in readers}
    orders.discard(("", 0))
    return bool(readers) and None not in orders and all(pairs.fit(values, *order) for order in orders if order)


def _readers(name: str, nodes: list[_Node]) -> Iterator[tuple[_Node, tuple[str, ...]]]:
    """Yield the nodes that read a weight, as it is or dequantized, and the names under which it is read."""
    for node in nodes:
        if name not in node.inputs:
            continue
        if node.operator == "DequantizeLinear" and node.inputs[0] == name:
            yield from _readers(node.outputs[0], nodes)
        else:
            yield node, (name,)


def _order(node: _Node, names: tuple[str, ...], rank: int) -> tuple[str, int] | None:
    """Return kind and output axis with which a node adds up a weight, ("", 0) when it does not, None when unknown."""
    if node.operator in LOOKS_UP:
        return "", 0
    index = WEIGHT_INPUT.get(node.operator)
    if index is None or [number for number, name in enumerate(node.inputs) if name in names] != [index]:
        return None
    if "Conv" in node.operator:
        return "Conv", 0
    return "MatMul" if not node.transposed else "Gemm", 0 if node.transposed else rank - 1


def _node(model: bytes | OpenFile, start: int, end: int) -> _Node:
    inputs: list[str] = []
    outputs: list[str] = []
    operator, transposed = "", False
    for field, at, to, _ in fields(model, start, end):
        if field in (INPUT, OUTPUT):
            (inputs if field == INPUT else outputs).append(_text(model, at, to))
        elif field == OPERATOR:
            operator = _text(model, at, to)
        elif field == ATTRIBUTE:
            transposed = transposed or _transposes(model, at, to)
    return _Node(operator, tuple(inputs), tuple(outputs), transposed)


def _transposes(model: bytes | OpenFile, start: int, end: int) -> bool:
    name, value = "", 0
    for field, at, to, number in fields(model, start, end):
        if field == ATTRIBUTE_NAME:
            name = _text(model, at, to)
        elif field == INTEGER:
            value = number
    return name == "transB" and bool(value)


def _tensor(model: bytes | OpenFile, start: int, end: int) -> tuple[str, _Weight | None]:
    """Return the name of a tensor, and where its data are if it is int8 and no scalar."""
    shape: list[int] = []
    name, dtype, place = "", 0, (0, 0)
    for field, at, to, number in fields(model, start, end):
        if field == DIMS:
            shape += [number] if number >= 0 else list(_packed(model, at, to))
        elif field == DATA_TYPE:
            dtype = number
        elif field == TENSOR_NAME:
            name = _text(model, at, to)
        elif field == RAW_DATA:
            place = at, to
    return name, _Weight(tuple(shape), *place) if dtype == INT8 and shape else None


def _packed(model: bytes | OpenFile, start: int, end: int) -> Iterator[int]:
    content, at = model[start:end], 0
    while at < len(content):
        number, at = varint(content, at, 10)
        yield number


def _text(model: bytes | OpenFile, start: int, end: int) -> str:
    try:
        return model[start:end].decode("utf-8")
    except UnicodeDecodeError:
        raise GraphError("The graph is not an ONNX model: a name in it is not UTF-8.") from None
