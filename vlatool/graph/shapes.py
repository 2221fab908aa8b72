"""Static shapes, dtypes and sizes of the tensors of an ONNX graph."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vlatool.errors import require
from vlatool.graph.nodes import nodes_inside
from vlatool.graph.onnx_graph import LARGE, static_shape

Shape = tuple[int, ...]

SAME_SHAPE_AS = {
    "DynamicQuantizeMatMul": "MatMul",
    "MatMulIntegerToFloat": "MatMulInteger",
    "FusedConv": "Conv",
    "QGemm": "Gemm",
}
"""Contributed operator -> the standard one with the same output shape; ONNX infers shapes of standard ones only."""
UNCHANGED = {"DequantizeLinear", "QuantizeLinear", "Transpose", "Reshape", "Squeeze", "Unsqueeze", "Cast", "Identity"}
"""Operators whose output holds the numbers of their first input, in another type or order."""


class Tensors:
    """The nodes of a graph and what is known of its tensors.

    Args:
        onnx: The imported ``onnx`` package.
        nodes: In the order in which they run.
        graph: The graph after shape inference.
    """

    def __init__(self, onnx: Any, nodes: list[Any], graph: Any) -> None:
        self._onnx, self.nodes, self._graph = onnx, nodes, graph
        self._types: dict[str, int] = {}
        self._shapes: dict[str, Shape | None] = {}
        for value in (*graph.input, *graph.value_info, *graph.output):
            self._types[value.name] = value.type.tensor_type.elem_type
            self._shapes[value.name] = static_shape(value.type.tensor_type)
        for item in graph.initializer:
            self._types[item.name], self._shapes[item.name] = item.data_type, tuple(item.dims)
        self._producers = {name: node for node in nodes for name in node.output if name}
        self._stored = {item.name for item in graph.initializer}

    def shape(self, name: str) -> Shape | None:
        """Return a shape of whole numbers, None when an axis is free or nothing is known."""
        return self._shapes.get(name)

    def dtype(self, name: str) -> str:
        """Return a dtype as ``float32``; ``float32`` when it is not known."""
        known = self._types.get(name, 0)
        if not known:
            return "float32"
        label = str(self._onnx.TensorProto.DataType.Name(known)).lower()
        if label.startswith(("float8", "float4")):  # float8e4m3fn and its kin
            return label[: len("float8")]
        return {"float": "float32", "double": "float64"}.get(label, label)

    def producer(self, name: str) -> Any | None:
        """Return the node that gives a tensor."""
        return self._producers.get(name)

    def is_constant(self, name: str) -> bool:
        """Say whether a tensor is a weight, or computed from weights alone (dequantized, transposed)."""
        while name not in self._stored:
            node = self._producers.get(name)
            if node is None or node.op_type not in UNCHANGED:
                return node is not None and node.op_type == "Constant"
            name = node.input[0]
        return True

    def root(self, name: str) -> str:
        """Return the name of the tensor whose numbers these are, before their type or order changed."""
        while name not in self._stored and (node := self._producers.get(name)) and node.op_type in UNCHANGED:
            name = node.input[0]
        return name

    def attribute(self, node: Any, name: str, default: Any) -> Any:
        """Return an attribute of a node, strings decoded."""
        for item in node.attribute:
            if item.name == name:
                value = self._onnx.helper.get_attribute_value(item)
                return value.decode() if isinstance(value, bytes) else value
        return default

    def bytes_of(self, name: str) -> int | None:
        """Return the size of a tensor in bytes, None when its shape is not static."""
        shape = self.shape(name)
        return None if shape is None else math.ceil(math.prod(shape) * bits(self.dtype(name)) / 8)

    @property
    def weight_bytes(self) -> int:
        """Bytes of all initializers."""
        return sum(self.bytes_of(item.name) or 0 for item in self._graph.initializer)

    def peak_bytes(self) -> int:
        """Return the most bytes of inputs, intermediate values and outputs that are alive at one node.

        What is computed from weights alone (a dequantized weight) is not counted: engines fold it or keep it packed.
        """
        constant = {*self._stored}
        last = {name: index for index, node in enumerate(self.nodes) for name in node.input}
        kept = {value.name for value in (*self._graph.input, *self._graph.output)}
        alive = {
            value.name: self.bytes_of(value.name) or 0 for value in self._graph.input if value.name not in self._stored
        }
        peak = sum(alive.values())
        for index, node in enumerate(self.nodes):
            if all(name in constant for name in node.input if name):
                constant.update(node.output)
                continue
            alive.update({name: self.bytes_of(name) or 0 for name in node.output if name})
            peak = max(peak, sum(alive.values()))
            for name in (*node.input, *node.output):
                if last.get(name, index) <= index and name not in kept:
                    alive.pop(name, None)
        return peak

    def hidden(self, operators: set[str]) -> Iterator[str]:
        """Yield the names of nodes that run such operators inside (branches and loops), which nothing here counts."""
        for node in self.nodes:
            if any(inner.op_type in operators for inner in nodes_inside(node)):
                yield node.name or node.output[0]


def open_graph(onnx: Any, path: Path) -> Tensors:
    """Read an ONNX file without its external weights and infer shapes, a free first axis of an input being 1."""
    model = onnx.load(str(path), load_external_data=False)
    if model.functions:
        model = require("onnx.inliner", "build").inline_local_functions(model)
    graph = model.graph
    nodes = copy.deepcopy([*graph.node])
    for value in graph.input:
        axes = value.type.tensor_type.shape.dim
        if axes and not axes[0].HasField("dim_value"):
            axes[0].dim_value = 1
    for value in graph.output:  # what was declared may name the axis that is now 1
        value.ClearField("type")
    for item in graph.initializer:  # shapes do not depend on weights; this keeps a copy of them out of the inference
        if len(item.raw_data) > LARGE:
            item.ClearField("raw_data")
    standard = [item for node in nodes for item in _standard(onnx, node, graph)]
    del graph.node[:]
    graph.node.extend(standard)
    inferred = onnx.shape_inference.infer_shapes(model, data_prop=True)
    return Tensors(onnx, nodes, inferred.graph)


def _standard(onnx: Any, node: Any, graph: Any) -> list[Any]:
    """Return standard operators with the same output shape and dtype as a contributed one; other nodes as they are."""
    kind, out = node.op_type, list(node.output)
    if kind == "MatMulNBits":
        sizes = {item.name: item.i for item in node.attribute}
        weight = f"{out[0]}::weight"
        shape = [sizes["K"], sizes["N"]]
        graph.value_info.append(onnx.helper.make_tensor_value_info(weight, onnx.TensorProto.FLOAT, shape))
        return [onnx.helper.make_node("MatMul", [node.input[0], weight], out)]
    if kind not in SAME_SHAPE_AS:
        return [node]
    inputs = [node.input[0], node.input[3 if kind == "QGemm" else 1]]
    if kind == "MatMulIntegerToFloat":
        integers = f"{out[0]}::int32"
        cast = onnx.helper.make_node("Cast", [integers], out, to=onnx.TensorProto.FLOAT)
        return [onnx.helper.make_node(SAME_SHAPE_AS[kind], inputs, [integers]), cast]
    replacement = onnx.helper.make_node(SAME_SHAPE_AS[kind], inputs, out)
    replacement.attribute.extend(
        item for item in node.attribute if kind == "FusedConv" or item.name.startswith("trans")
    )
    return [replacement]


def bits(dtype: str) -> int:
    """Return the bits of one element; 8 for a dtype without a number in its name."""
    return int("".join(character for character in dtype if character.isdigit()) or 8)
