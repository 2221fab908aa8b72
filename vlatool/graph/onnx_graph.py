"""The graph of an ONNX model: producers and readers of values, constants, types, shapes, and edits in place."""

from __future__ import annotations

import graphlib
import heapq
from collections import defaultdict
from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import require
from vlatool.graph.nodes import read_names, reads

FLOAT = 1  # onnx.TensorProto.FLOAT
LARGE_CONSTANT = 4096
"""Bytes above which a constant is a weight; constants that determine shapes are smaller."""
DOMAINS = ("", "ai.onnx")
"""Names of the standard domain."""


class OnnxGraph:
    """A graph in protobuf with lookups and edits in place: untouched parts keep their bytes and their order.

    Lookups are computed at their first use and reflect the graph at that time; only ``constants`` follows edits. Nodes
    count as readers of values that their subgraphs (If, Loop, Scan) capture.

    Args:
        model: An ``onnx.ModelProto``.
    """

    def __init__(self, model: Any) -> None:
        self.onnx = require("onnx", "build")
        self.model, self.graph = model, model.graph
        self.opset: int = next((entry.version for entry in model.opset_import if entry.domain in DOMAINS), 0)

    @cached_property
    def constants(self) -> dict[str, Any]:
        """Name -> ``TensorProto`` of each initializer."""
        return {tensor.name: tensor for tensor in self.graph.initializer}

    @cached_property
    def producers(self) -> dict[str, Any]:
        """Value -> the node that produces it."""
        return {name: node for node in self.graph.node for name in node.output if name}

    @cached_property
    def readers(self) -> dict[str, list[Any]]:
        """Value -> the nodes that read it, repeated for each read; empty for an unread value."""
        readers: dict[str, list[Any]] = defaultdict(list)
        for node in self.graph.node:
            for name in reads(node):
                readers[name].append(node)
        return readers

    @cached_property
    def outputs(self) -> set[str]:
        """Names of the outputs."""
        return {value.name for value in self.graph.output}

    # ---- types and shapes

    @cached_property
    def value_infos(self) -> list[Any]:
        """``onnx.ValueInfoProto`` of inputs, inferred values and outputs.

        Weights take part as inputs of their type and shape: neither their bytes nor protobuf's limit of 2 GiB matter.
        """
        graph, helper, external = self.graph, self.onnx.helper, self.onnx.TensorProto.EXTERNAL
        small, inputs = [], list(graph.input)
        for tensor in graph.initializer:
            if tensor.ByteSize() > LARGE_CONSTANT or tensor.data_location == external:
                inputs.append(helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
            else:
                small.append(tensor)
        light = helper.make_graph(list(graph.node), graph.name or "graph", inputs, list(graph.output), small)
        model = helper.make_model(light, opset_imports=self.model.opset_import, ir_version=self.model.ir_version)
        inferred = self.onnx.shape_inference.infer_shapes(model, data_prop=True).graph
        return [*graph.input, *inferred.value_info, *inferred.output]

    @cached_property
    def types(self) -> dict[str, int]:
        """Value -> ``onnx.TensorProto.DataType``; constants are not among them."""
        return {value.name: value.type.tensor_type.elem_type for value in self.value_infos}

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Value or constant -> shape, of those whose shape is fixed."""
        shapes = {name: tuple(tensor.dims) for name, tensor in self.constants.items()}
        static = ((value.name, static_shape(value.type.tensor_type)) for value in self.value_infos)
        return shapes | {name: shape for name, shape in static if shape is not None}

    def float_values(self) -> list[str]:
        """Return the float32 outputs of all nodes, in order."""
        return [name for node in self.graph.node for name in node.output if self.types.get(name) == FLOAT]

    # ---- constants

    def array(self, name: str) -> NDArray[Any]:
        """Return the values of a constant."""
        values: NDArray[Any] = self.onnx.numpy_helper.to_array(self.constants[name])
        return values

    def is_weight(self, name: str, rank: int | None = None) -> bool:
        """Return whether a value is a float32 constant, of the given rank."""
        tensor = self.constants.get(name)
        return tensor is not None and tensor.data_type == FLOAT and rank in (None, len(tensor.dims))

    def is_scalar(self, name: str) -> bool:
        """Return whether a value is a constant with a single element."""
        return name in self.constants and all(axis == 1 for axis in self.constants[name].dims)

    def add(self, name: str, values: Any, dtype: Any = None) -> str:
        """Add a constant unless one of that name exists; return the name."""
        if name in self.constants:
            return name
        return self.add_tensor(self.onnx.numpy_helper.from_array(np.asarray(values, dtype, order="C"), name))

    def add_tensor(self, tensor: Any, name: str = "") -> str:
        """Add a copy of a ``TensorProto``, optionally under another name; return its name."""
        self.graph.initializer.append(tensor)
        copy = self.graph.initializer[-1]
        copy.name = name or copy.name
        self.constants[copy.name] = copy
        return str(copy.name)

    # ---- nodes

    def node(self, kind: str, inputs: Iterable[str], outputs: Iterable[str], name: str = "", **attributes: Any) -> Any:
        """Create a node without adding it to the graph."""
        return self.onnx.helper.make_node(kind, inputs, outputs, name, **attributes)

    def attributes(self, node: Any) -> dict[str, Any]:
        """Return the attributes of a node; texts are bytes."""
        return {item.name: self.onnx.helper.get_attribute_value(item) for item in node.attribute}

    def replace_nodes(self, nodes: Iterable[Any]) -> None:
        """Replace all nodes of the graph."""
        kept = list(nodes)
        del self.graph.node[:]
        self.graph.node.extend(kept)

    def insert_before(self, node: Any, *added: Any) -> None:
        """Insert nodes before a node of the graph."""
        position = list(self.graph.node).index(node)
        for number, new in enumerate(added):
            self.graph.node.insert(position + number, new)

    def replace_reads(self, old: str, new: str) -> None:
        """Redirect all readers of a value to another one."""
        for node in self.graph.node:
            for index, name in enumerate(node.input):
                if name == old:
                    node.input[index] = new

    def drop_unread_constants(self) -> None:
        """Remove the constants that neither a node nor an output uses; the others are not copied."""
        used = read_names(self.graph.node) | self.outputs
        for index in range(len(self.graph.initializer) - 1, -1, -1):
            if self.graph.initializer[index].name not in used:
                del self.graph.initializer[index]

    def drop_unread(self) -> None:
        """Remove nodes and constants that no output depends on; the nodes must be sorted."""
        used, kept = set(self.outputs), []
        for node in reversed(self.graph.node):
            if not used.isdisjoint(node.output):
                kept.append(node)
                used.update(reads(node))
        self.replace_nodes(reversed(kept))
        self.drop_unread_constants()

    def sort(self) -> None:
        """Sort nodes topologically, otherwise in their current order."""
        nodes = list(self.graph.node)
        origin = {name: index for index, node in enumerate(nodes) for name in node.output if name}
        before = {index: {origin[name] for name in reads(node) if name in origin} for index, node in enumerate(nodes)}
        sorter = graphlib.TopologicalSorter(before)
        sorter.prepare()
        ready: list[int] = []
        order = []
        while sorter.is_active():
            for index in sorter.get_ready():
                heapq.heappush(ready, index)
            order.append(heapq.heappop(ready))
            sorter.done(order[-1])
        self.replace_nodes(nodes[index] for index in order)


def type_name(code: int) -> str:
    """Return numpy's name of a ``TensorProto.DataType``: ``float64``, ``bfloat16``.

    Example:
        >>> type_name(11)
        'float64'
    """
    label = str(require("onnx", "build").TensorProto.DataType.Name(code)).lower()
    return {"float": "float32", "double": "float64"}.get(label, label)


def static_shape(tensor_type: Any) -> tuple[int, ...] | None:
    """Return the shape of an ``onnx.TypeProto.Tensor``; None where an axis is dynamic or unknown."""
    if not tensor_type.HasField("shape"):
        return None
    axes = tensor_type.shape.dim
    return tuple(axis.dim_value for axis in axes) if all(axis.HasField("dim_value") for axis in axes) else None
