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
from vlatool.runtime.external_data import COPY_AGAIN, OpenFile, asked_of, fields, messages, varint
from vlatool.weights import pairs

UINT8, INT8 = 2, 3
"""``TensorProto.DataType``."""
DIMS, DATA_TYPE, TENSOR_NAME, RAW_DATA = 1, 2, 8, 9
"""Numbers of fields of ``TensorProto`` (onnx.proto)."""
INPUT, OUTPUT, OPERATOR, ATTRIBUTE, DOMAIN = 1, 2, 4, 5, 7
"""Those of ``NodeProto``."""
ATTRIBUTE_NAME, INTEGER = 1, 3
"""Those of ``AttributeProto``."""
WEIGHT_INPUT = {
    "MatMul": 1, "Gemm": 1, "Conv": 1, "MatMulInteger": 1, "MatMulIntegerToFloat": 1, "DynamicQuantizeMatMul": 1,
    "ConvInteger": 1, "QLinearMatMul": 3, "QLinearConv": 3, "QGemm": 3,
}  # fmt: skip
"""Operator -> which input its weight is."""
INTEGER_ONLY = tuple(each for each in WEIGHT_INPUT if each not in ("MatMul", "Gemm", "Conv"))
"""Those of them whose operands are integers; the others have them behind a ``DequantizeLinear``."""
MAX_WEIGHT = 64
"""Largest magnitude of two int8 numbers whose products with 255 add up within 16 bits: 255 x 2 x 64 = 32,640."""
MOST_AXES = 16
"""Of a weight; no operator here reads one of more."""
LOOKS_UP = ("Gather", "GatherND", "GatherElements")
"""Operators that read rows of a weight and multiply nothing."""
MOVES = (
    *LOOKS_UP, "Reshape", "Transpose", "Split", "Squeeze", "Unsqueeze", "Flatten", "Identity", "Slice", "Expand",
    "Concat", "Tile", "DepthToSpace", "SpaceToDepth",
)  # fmt: skip
"""Operators that hand on what they read, in another place."""
DOMAINS = ("", "ai.onnx", "com.microsoft")
"""Whose operators these names are; one of another domain may do anything."""


@dataclass(frozen=True)
class _Node:
    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    transposed: bool

    @property
    def passed_inputs(self) -> tuple[str, ...]:
        """What it hands on: shapes and indices are its other inputs."""
        return self.inputs if self.operator == "Concat" else self.inputs[:1]


@dataclass(frozen=True)
class _Weight:
    shape: tuple[int, ...]
    start: int
    end: int


def weights_fit(model: Path | bytes) -> bool:
    """Return whether no product of uint8 activations with an int8 operand saturates, whatever the activations are.

    The second operand of each product is a stored weight, whose pairs are looked at, or a quantized activation: in
    uint8, which engines multiply exactly, or in int8 behind a ``Clip`` to 64. False where that cannot be told: weights
    beside the graph, two of one name, readers that are not known, and other int8 operands that the graph computes
    (from float32 weights, say).

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
    types: dict[str, int] = {}
    bounds: dict[str, int] = {}
    for message, start, end in messages(model, lambda *_: True):
        if message == "NodeProto":
            nodes.append(_node(model, start, end))
        elif message == "TensorProto":
            name, dtype, weight = _tensor(model, start, end)
            types[name] = dtype if types.setdefault(name, dtype) == dtype else 0
            if weight is None:
                continue
            if not weight.shape:
                values = np.frombuffer(model[weight.start : weight.end], np.int8).astype(int)
                bounds[name] = max(abs(int(values[0])) if values.size == 1 else 128, bounds.get(name, 0))
            elif weights.setdefault(name, weight) is not weight:
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
        and _Operands(nodes, frozenset(matrices), types, bounds).is_known()
    )


class _Operands:
    """Where the second operand of each product comes from.

    Args:
        nodes: All nodes, those of branches and functions, too.
        weights: Names of the stored int8 matrices, whose readers are looked at elsewhere.
        types: Tensor -> its ``TensorProto.DataType``.
        scalars: Stored int8 scalar -> its largest magnitude.
    """

    def __init__(
        self, nodes: list[_Node], weights: frozenset[str], types: dict[str, int], scalars: dict[str, int]
    ) -> None:
        self._nodes, self._weights, self._types, self._scalars = nodes, weights, types, scalars
        self._makers: dict[str, _Node] = {}
        self._unique = True
        for node in nodes:
            for name in filter(None, node.outputs):
                self._unique = self._unique and name not in self._makers and name not in weights
                self._makers[name] = node

    def is_known(self) -> bool:
        """Return whether each is a stored weight, in float32, or an integer with which no pair saturates."""
        products = [node for node in self._nodes if node.operator in WEIGHT_INPUT]
        open_ = [(name, node.operator in INTEGER_ONLY)
                 for node in products for name in node.inputs[WEIGHT_INPUT[node.operator] :][:1]
                 if name not in self._weights]  # fmt: skip
        seen: set[tuple[str, bool]] = set()
        while open_:
            if (one := open_.pop()) in seen:
                continue
            seen.add(one)
            further = self._further(*one)
            if further is None:
                return False
            open_ += further
        return self._unique

    def _further(self, name: str, integer: bool) -> list[tuple[str, bool]] | None:
        """Return what a value depends on, with whether that is an integer; None when it may saturate."""
        maker = self._makers.get(name)
        if maker is None:
            return None if integer else []
        if maker.operator == "DequantizeLinear":
            return [(source, True) for source in maker.inputs[:1] if source not in self._weights]
        if maker.operator == "Clip" and integer and self._bounds(maker):
            return []
        if maker.operator in (*MOVES, "Clip"):
            return [(each, integer) for each in maker.passed_inputs]
        return [] if not integer or self._makes_uint8(maker) else None

    def _bounds(self, clip: _Node) -> bool:
        """Return whether a ``Clip`` keeps an int8 within what no pair saturates with."""
        given = clip.inputs[1:3]
        return len(given) == 2 and all(
            self._scalars.get(name, 128) <= MAX_WEIGHT and name not in self._makers for name in given
        )

    def _makes_uint8(self, maker: _Node) -> bool:
        zero = maker.inputs[2:3]
        if maker.operator == "QuantizeLinear":
            return bool(zero) and self._types.get(zero[0]) == UINT8 and zero[0] not in self._makers
        return maker.operator == "DynamicQuantizeLinear"


def _met(model: bytes | OpenFile, name: str, weight: _Weight, nodes: list[_Node]) -> bool:
    """Return whether all readers of a weight are known, and none of them saturates with it."""
    if weight.end - weight.start != math.prod(weight.shape) or len(weight.shape) > MOST_AXES:
        return False
    readers = list(_readers(name, nodes))
    values = np.frombuffer(model[weight.start : weight.end], np.int8).reshape(weight.shape)
    orders = {_order(node, names, len(weight.shape)) for node, names in readers}
    orders.discard(("", 0))
    return bool(readers) and None not in orders and all(pairs.pairs_fit(values, *order) for order in orders if order)


def _readers(name: str, nodes: list[_Node]) -> Iterator[tuple[_Node, tuple[str, ...]]]:
    """Yield the nodes that read a weight, as it is or dequantized, and the names under which it is read."""
    for node in nodes:
        if name not in node.inputs:
            continue
        if node.operator == "DequantizeLinear" and node.inputs[0] == name and node.outputs:
            yield from ((reader, node.outputs[:1]) for reader in nodes if node.outputs[0] in reader.inputs)
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
    operator, domain, transposed = "", "", False
    for field, at, to, _ in fields(model, start, end):
        if field in (INPUT, OUTPUT):
            (inputs if field == INPUT else outputs).append(text_at(model, at, to))
        elif field == OPERATOR:
            operator = text_at(model, at, to)
        elif field == DOMAIN:
            domain = text_at(model, at, to)
        elif field == ATTRIBUTE:
            transposed = transposed or _transposes(model, at, to)
    own = operator if domain in DOMAINS else f"{domain}.{operator}"
    return _Node(own, tuple(inputs), tuple(outputs), transposed)


def _transposes(model: bytes | OpenFile, start: int, end: int) -> bool:
    name, value = "", 0
    for field, at, to, number in fields(model, start, end):
        if field == ATTRIBUTE_NAME:
            name = text_at(model, at, to)
        elif field == INTEGER:
            value = number
    return name == "transB" and bool(value)


def _tensor(model: bytes | OpenFile, start: int, end: int) -> tuple[str, int, _Weight | None]:
    """Return the name and type of a tensor, and where its data are if it is int8."""
    shape: list[int] = []
    name, dtype, span = "", 0, (0, 0)
    for field, at, to, number in fields(model, start, end):
        if field == DIMS:
            shape += [number] if number >= 0 else list(packed_numbers(model, at, to))
        elif field == DATA_TYPE:
            dtype = number
        elif field == TENSOR_NAME:
            name = text_at(model, at, to)
        elif field == RAW_DATA:
            span = at, to
    return name, dtype, _Weight(tuple(shape), *span) if dtype == INT8 else None


def packed_numbers(model: bytes | OpenFile, start: int, end: int) -> Iterator[int]:
    """Yield the numbers of a field that holds several; raises GraphError where one is cut off."""
    content, at = model[start:end], 0
    while at < len(content):
        number, at = varint(content, at, 10)
        yield number


def text_at(model: bytes | OpenFile, start: int, end: int) -> str:
    """Return the text of a field; raises GraphError for bytes that are not UTF-8."""
    try:
        return model[start:end].decode("utf-8")
    except UnicodeDecodeError:
        raise GraphError("The graph is not an ONNX model: a name in it is not UTF-8.", COPY_AGAIN) from None
