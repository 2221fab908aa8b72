"""Multiply-accumulates and precision of one layer of an ONNX graph."""

from __future__ import annotations

import math
from typing import Any

from vlatool.graph.shapes import Shape, Tensors, bits

INTEGER_OPS = {
    *("MatMulInteger", "ConvInteger", "QLinearMatMul", "QLinearConv"),
    *("QGemm", "DynamicQuantizeMatMul", "MatMulIntegerToFloat"),
}
"""Operators that always compute in int8."""
WEIGHT_AT = {"QLinearMatMul": 3, "QLinearConv": 3, "QGemm": 3}
"""Index of the second operand where it is not 1."""
MATMULS = {"MatMul", "FusedMatMul", "MatMulInteger", "QLinearMatMul", "DynamicQuantizeMatMul", "MatMulIntegerToFloat"}
CONVOLUTIONS = {"Conv", "ConvInteger", "QLinearConv", "FusedConv"}
OTHER_PRODUCTS = {"Gemm", "QGemm", "ConvTranspose", "MatMulNBits", "Einsum", "Attention", "LSTM", "GRU", "RNN"}
TRANSPOSING = ("Gemm", "QGemm", "FusedMatMul")
"""Operators that can transpose the last two axes of their first operand."""
OPAQUE = {"QAttention", "MultiHeadAttention", "GroupQueryAttention"}
"""Compute operators that are not counted: a graph with one has an unknown layer, never a wrong sum."""
MOVE_OPS = {"Reshape", "Transpose", "Unsqueeze", "Squeeze", "Flatten", "Split", "Slice", "Pad", "MaxPool"}
"""Operators that move values without changing their precision."""
COMPUTE = MATMULS | CONVOLUTIONS | OTHER_PRODUCTS | OPAQUE


def precision_of(node: Any, tensors: Tensors) -> str:
    """Return the precision in which a layer is computed.

    A float layer counts as int8 when both operands come from DequantizeLinear (QDQ form); when only the weight does, it
    is computed in float.
    """
    if node.op_type in INTEGER_OPS:
        return "int8"
    if node.op_type == "MatMulNBits":
        return f"int{tensors.attribute(node, 'bits', 4)}"
    sources = [_source(name, tensors) for name in node.input[:2]]
    if len(sources) == 2 and all(source is not None and source.op_type == "DequantizeLinear" for source in sources):
        stored = [tensors.dtype(source.input[0]) for source in sources if source is not None]
        return min((name.removeprefix("u") for name in stored), key=bits)
    return tensors.dtype(node.input[0])


def weight_precision(node: Any, tensors: Tensors) -> str:
    """Return the precision of a layer's weights where only they are quantized (``int4``); empty for any other layer.

    How such a layer is computed depends on the engine: one dequantizes the weights, another rounds the activations.
    """
    if node.op_type == "MatMulNBits":
        return precision_of(node, tensors)
    first, second, *_ = *(_source(name, tensors) for name in node.input[:2]), None, None
    if node.op_type in INTEGER_OPS or second is None or second.op_type != "DequantizeLinear":
        return ""
    stored = tensors.is_constant(second.input[0]) and (first is None or first.op_type != "DequantizeLinear")
    return tensors.dtype(second.input[0]).removeprefix("u") if stored else ""


def _source(name: str, tensors: Tensors) -> Any:
    """Return the node that produced a value, before any moves."""
    node = tensors.producer(name)
    while node is not None and node.op_type in MOVE_OPS:
        node = tensors.producer(node.input[0])
    return node


def second_operand(node: Any) -> str:
    """Return the name of the second value that a compute layer multiplies; empty where it has none."""
    index = WEIGHT_AT.get(node.op_type, 1)
    return str(node.input[index]) if len(node.input) > index else ""


def node_macs(node: Any, tensors: Tensors) -> int | None:
    """Return the multiply-accumulates of a compute layer; None when a shape that it needs is not static."""
    kind = node.op_type
    if kind in OPAQUE or (kind == "Attention" and node.domain):
        return None
    first, out = tensors.shape(node.input[0]), tensors.shape(node.output[0])
    second = tensors.shape(second_operand(node))
    if kind == "MatMulNBits":
        return None if out is None else math.prod(out) * int(tensors.attribute(node, "K", 0))
    if first is None or second is None:
        return None
    if kind in ("LSTM", "GRU", "RNN"):  # first (steps, batch, width); weights (directions, gates x hidden, width)
        recurrent = tensors.shape(node.input[2])
        return None if recurrent is None else first[0] * first[1] * (math.prod(second) + math.prod(recurrent))
    if kind == "Einsum":
        return _einsum(str(tensors.attribute(node, "equation", "")), (first, second))
    if kind == "Attention":
        return _attention(node, tensors, first, second)
    if kind == "ConvTranspose":  # each input element meets (outputs / group) x kernel weights
        return math.prod(first) * math.prod(second[1:])
    if out is None:
        return None
    if kind in CONVOLUTIONS:  # each output element sums (inputs / group) x kernel products
        return math.prod(out) * math.prod(second[1:])
    inner = first[-2] if kind in TRANSPOSING and tensors.attribute(node, "transA", 0) else first[-1]
    return math.prod(out) * inner


def _einsum(equation: str, shapes: tuple[Shape, Shape]) -> int | None:
    """Return the product of the sizes of all distinct subscripts of a two-operand Einsum."""
    operands = equation.replace(" ", "").partition("->")[0].split(",")
    if len(operands) != 2 or any(len(names) != len(shape) for names, shape in zip(operands, shapes, strict=True)):
        return None
    sizes = dict(zip("".join(operands), (*shapes[0], *shapes[1]), strict=True))
    return math.prod(sizes.values())


def _attention(node: Any, tensors: Tensors, query: Shape, key: Shape) -> int | None:
    """Return query x key + weights x value of the standard Attention operator, in its 4-D or 3-D form."""
    value = tensors.shape(node.input[2])
    if value is None or len(node.input) > 4:  # with a key-value cache the length is not static
        return None
    if len(query) == 4:
        return math.prod(query[:3]) * key[2] * (query[3] + value[3])
    shared = int(tensors.attribute(node, "q_num_heads", 1)) // int(tensors.attribute(node, "kv_num_heads", 1))
    return query[0] * query[1] * key[1] * (query[2] + value[2] * shared)
