"""Static shapes, dtypes and sizes of the tensors of an ONNX graph."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.graph.control_flow import Branches, LoopBody, all_nodes, flatten, with_unique_names
from vlatool.graph.nodes import inner_nodes
from vlatool.graph.onnx_graph import DOMAINS, LARGE_CONSTANT, static_shape, type_name
from vlatool.graph.run_shapes import RunShapes, read_run_shapes

Shape = tuple[int, ...]

SAME_SHAPE_AS = {
    "DynamicQuantizeMatMul": "MatMul",
    "MatMulIntegerToFloat": "MatMulInteger",
    "FusedConv": "Conv",
    "QGemm": "Gemm",
}
"""Contributed operator -> standard one with the same output shape; ONNX infers shapes only of standard operators."""
COPY_OPS = {"DequantizeLinear", "QuantizeLinear", "Transpose", "Reshape", "Squeeze", "Unsqueeze", "Cast", "Identity"}
"""Operators whose output holds the values of their first input, in another type or order."""


class Tensors:
    """The nodes of a graph with shapes and types of its tensors.

    Args:
        onnx: The imported ``onnx`` package.
        items: Nodes in execution order, with nested bodies (``vlatool.graph.control_flow``).
        graph: The graph after shape inference.
        run_shapes: Node -> shapes of a run, where shapes are not static.
    """

    def __init__(self, onnx: Any, items: list[Any], graph: Any, run_shapes: Mapping[str, RunShapes]) -> None:
        self._onnx, self.items, self._graph, self._run_shapes = onnx, items, graph, run_shapes
        self.nodes = [*all_nodes(items)]
        self._types: dict[str, int] = {}
        self._shapes: dict[str, Shape | None] = {}
        for value in (*graph.input, *graph.value_info, *graph.output):
            self._types[value.name] = value.type.tensor_type.elem_type
            self._shapes[value.name] = static_shape(value.type.tensor_type)
        for item in graph.initializer:
            self._types[item.name], self._shapes[item.name] = item.data_type, tuple(item.dims)
        self._producers = {name: node for node in self.nodes for name in node.output if name}
        self._stored = {item.name for item in graph.initializer}
        for node in (node for node in self.nodes if node.name in run_shapes):
            self._add_run_shapes(node, run_shapes[node.name])

    def _add_run_shapes(self, node: Any, seen: RunShapes) -> None:
        """Add the shapes of a node in a run, where they are not static."""
        pending, missing = list(seen.inputs), sum(map(bool, node.input)) - len(seen.inputs)
        for name in filter(None, node.input):
            packed = missing > 0 and name in self._stored and pending[:1] != [self._shapes[name]]
            missing -= packed
            shape = pending.pop(0) if pending and not packed else None
            self._shapes[name] = self._shapes.get(name) or shape
        for name, shape in zip(filter(None, node.output), seen.outputs, strict=False):
            self._shapes[name] = self._shapes.get(name) or shape

    def shape(self, name: str) -> Shape | None:
        """Return a static shape; None when an axis is dynamic or unknown."""
        return self._shapes.get(name)

    def dtype(self, name: str) -> str:
        """Return the name of a dtype; ``float32`` when it is unknown."""
        known = self._types.get(name, 0)
        if not known:
            return "float32"
        label = type_name(known)
        return label[: len("float8")] if label.startswith(("float8", "float4")) else label  # float8e4m3fn and its kin

    def producer(self, name: str) -> Any | None:
        """Return the node that produces a tensor."""
        return self._producers.get(name)

    def is_constant(self, name: str) -> bool:
        """Return whether a tensor is a weight, or derived only from weights (dequantized, transposed)."""
        while name not in self._stored:
            node = self._producers.get(name)
            if node is None or node.op_type not in COPY_OPS:
                return node is not None and node.op_type == "Constant"
            name = node.input[0]
        return True

    def source_tensor(self, name: str) -> str:
        """Return the tensor whose values these are, before changes of type or order."""
        while name not in self._stored and (node := self._producers.get(name)) and node.op_type in COPY_OPS:
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
        """Return the peak of bytes of live inputs, intermediate values and outputs.

        Values derived only from weights (a dequantized weight) are not counted: engines fold them or keep them packed.
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

    def nodes_with_inner(self, operators: set[str]) -> Iterator[str]:
        """Yield the names of nodes with such operators in bodies that are not counted here."""
        for node in self.nodes:
            if any(inner.op_type in operators for inner in inner_nodes(node)):
                yield node.name or node.output[0]

    def run_counts(self, items: Sequence[Any], macs: Callable[[Any], int], times: int = 1) -> list[tuple[Any, int]]:
        """Return the nodes that run, and the number of runs of each; 0: unknown.

        Of the branches of an If, the one with the most multiply-accumulates counts.

        Args:
            items: Nodes with nested bodies, such as ``items`` of the graph.
            macs: Function that returns the multiply-accumulates of a node.
            times: Number of runs of the items.
        """
        found: list[tuple[Any, int]] = []
        for item in items:
            if isinstance(item, Branches):
                bodies = [self.run_counts(body, macs, times) for body in item.bodies]
                costs = [sum(macs(node) * max(1, count) for node, count in body) for body in bodies]
                found += bodies[costs.index(max(costs))]
            elif isinstance(item, LoopBody):
                found += [] if item.count == 0 else self.run_counts(item.body, macs, times * self._loop_count(item))
            else:
                seen = self._run_shapes.get(item.name)
                found.append((item, times or (seen.times if seen else 0)))
        return found

    def _loop_count(self, item: LoopBody) -> int:
        if item.count is not None:
            return item.count
        shape = self.shape(item.along[0]) if item.along else None
        return shape[item.along[1]] if shape is not None and item.along else 0


def open_graph(onnx: Any, path: Path) -> Tensors:
    """Read an ONNX file without its external weights and infer shapes; a dynamic first axis of an input becomes 1."""
    model = with_unique_names(onnx.load(str(path), load_external_data=False))
    graph = model.graph
    for value in graph.input:
        axes = value.type.tensor_type.shape.dim
        if axes and not axes[0].HasField("dim_value"):
            axes[0].dim_value = 1
    for value in graph.output:  # the declared type may name the axis that is now 1
        value.ClearField("type")
    for item in graph.initializer:  # shapes do not depend on weights; this keeps a copy of them out of the inference
        if len(item.raw_data) > LARGE_CONSTANT:
            item.ClearField("raw_data")
    items: list[Any] = copy.deepcopy([*graph.node])
    if any(item.HasField("g") for node in items for item in node.attribute):
        before = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
        known = {value.name: value for value in (*before.input, *before.value_info, *before.output)}
        opset = next((entry.version for entry in model.opset_import if entry.domain in DOMAINS), 0)
        items = flatten(graph, opset, known)
    standard = [item for node in copy.deepcopy([*graph.node]) for item in _standard_nodes(onnx, node, graph)]
    del graph.node[:]
    graph.node.extend(standard)
    inferred = onnx.shape_inference.infer_shapes(model, data_prop=True)
    return Tensors(onnx, items, inferred.graph, read_run_shapes(model))


def _standard_nodes(onnx: Any, node: Any, graph: Any) -> list[Any]:
    """Return standard operators with the output shape and dtype of a contributed one; other nodes unchanged."""
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
