"""Static shapes, dtypes and sizes of the tensors of an ONNX graph."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.graph.flat import Branches, Turns, all_nodes, flatten, named_everywhere
from vlatool.graph.nodes import nodes_inside
from vlatool.graph.onnx_graph import DOMAINS, LARGE, static_shape, type_name
from vlatool.graph.seen import Seen, read_seen

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
        items: Nodes in the order in which they run, and bodies that one of them has (``vlatool.graph.flat``).
        graph: The graph after shape inference.
        seen: Node -> what a run has shown, where shapes are not static.
    """

    def __init__(self, onnx: Any, items: list[Any], graph: Any, seen: Mapping[str, Seen]) -> None:
        self._onnx, self.items, self._graph, self._seen = onnx, items, graph, seen
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
        for node in (node for node in self.nodes if node.name in seen):
            self._learn(node, seen[node.name])

    def _learn(self, node: Any, seen: Seen) -> None:
        """Take in the shapes that a run has shown of a node, where they are not static."""
        pending, missing = list(seen.inputs), sum(map(bool, node.input)) - len(seen.inputs)
        for name in filter(None, node.input):
            packed = missing > 0 and name in self._stored and pending[:1] != [self._shapes[name]]
            missing -= packed
            shape = pending.pop(0) if pending and not packed else None
            self._shapes[name] = self._shapes.get(name) or shape
        for name, shape in zip(filter(None, node.output), seen.outputs, strict=False):
            self._shapes[name] = self._shapes.get(name) or shape

    def shape(self, name: str) -> Shape | None:
        """Return a shape of whole numbers, None when an axis is free or nothing is known."""
        return self._shapes.get(name)

    def dtype(self, name: str) -> str:
        """Return a dtype as ``float32``; ``float32`` when it is not known."""
        known = self._types.get(name, 0)
        if not known:
            return "float32"
        label = type_name(known)
        return label[: len("float8")] if label.startswith(("float8", "float4")) else label  # float8e4m3fn and its kin

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
        """Yield the names of nodes that run such operators inside, which nothing here counts: bodies of other nodes."""
        for node in self.nodes:
            if any(inner.op_type in operators for inner in nodes_inside(node)):
                yield node.name or node.output[0]

    def runs(self, macs: Callable[[Any], int]) -> list[tuple[Any, int]]:
        """Return the nodes that run, and how often each does; 0: nobody knows how often.

        Of the branches of an If it is the one with the most multiply-accumulates.

        Args:
            macs: Returns those of a node.
        """
        return self._runs(self.items, 1, macs)

    def _runs(self, items: Sequence[Any], times: int, macs: Callable[[Any], int]) -> list[tuple[Any, int]]:
        found: list[tuple[Any, int]] = []
        for item in items:
            if isinstance(item, Branches):
                bodies = [self._runs(body, times, macs) for body in item.bodies]
                costs = [sum(macs(node) * max(1, count) for node, count in body) for body in bodies]
                found += bodies[costs.index(max(costs))]
            elif isinstance(item, Turns):
                found += [] if item.count == 0 else self._runs(item.body, times * self._turns(item), macs)
            else:
                seen = self._seen.get(item.name)
                found.append((item, times or (seen.times if seen else 0)))
        return found

    def _turns(self, item: Turns) -> int:
        if item.count is not None:
            return item.count
        shape = self.shape(item.along[0]) if item.along else None
        return shape[item.along[1]] if shape is not None and item.along else 0


def open_graph(onnx: Any, path: Path) -> Tensors:
    """Read an ONNX file without its external weights and infer shapes, a free first axis of an input being 1."""
    model = named_everywhere(onnx.load(str(path), load_external_data=False))
    graph = model.graph
    for value in graph.input:
        axes = value.type.tensor_type.shape.dim
        if axes and not axes[0].HasField("dim_value"):
            axes[0].dim_value = 1
    for value in graph.output:  # what was declared may name the axis that is now 1
        value.ClearField("type")
    for item in graph.initializer:  # shapes do not depend on weights; this keeps a copy of them out of the inference
        if len(item.raw_data) > LARGE:
            item.ClearField("raw_data")
    items: list[Any] = copy.deepcopy([*graph.node])
    if any(item.HasField("g") for node in items for item in node.attribute):
        before = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
        known = {value.name: value for value in (*before.input, *before.value_info, *before.output)}
        opset = next((entry.version for entry in model.opset_import if entry.domain in DOMAINS), 0)
        items = flatten(graph, opset, known)
    standard = [item for node in copy.deepcopy([*graph.node]) for item in _standard(onnx, node, graph)]
    del graph.node[:]
    graph.node.extend(standard)
    inferred = onnx.shape_inference.infer_shapes(model, data_prop=True)
    return Tensors(onnx, items, inferred.graph, read_seen(model))


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
