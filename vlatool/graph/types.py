"""Shapes and types of the values of a graph, inferred without a copy of its weights."""

from __future__ import annotations

from typing import Any

from vlatool.errors import require

FLOAT = 1  # onnx.TensorProto.FLOAT
LARGE = 4096
"""Bytes from which a constant is a weight; what shapes are computed from is smaller."""


def inferred_values(model: Any) -> list[Any]:
    """Return ``onnx.ValueInfoProto`` of inputs, inferred values and outputs of a graph.

    Weights take part as inputs of their type and shape: neither their bytes nor protobuf's limit of 2 GiB matter.
    """
    onnx = require("onnx", "build")
    graph, helper = model.graph, onnx.helper
    small: list[Any] = []
    large: list[Any] = []
    for tensor in graph.initializer:
        weight = tensor.ByteSize() > LARGE or tensor.data_location == onnx.TensorProto.EXTERNAL
        (large if weight else small).append(tensor)
    inputs = [*graph.input, *(helper.make_tensor_value_info(item.name, item.data_type, item.dims) for item in large)]
    light = helper.make_graph(list(graph.node), graph.name or "graph", inputs, list(graph.output), small)
    made = helper.make_model(light, opset_imports=list(model.opset_import), ir_version=model.ir_version)
    found = onnx.shape_inference.infer_shapes(made, data_prop=True).graph
    return [*graph.input, *found.value_info, *found.output]


def static_shapes(model: Any) -> dict[str, tuple[int, ...]]:
    """Return value or constant -> shape, of those whose shape is fixed."""
    found = {tensor.name: tuple(tensor.dims) for tensor in model.graph.initializer}
    for value in inferred_values(model):
        kind = value.type.tensor_type
        if kind.HasField("shape") and all(axis.HasField("dim_value") for axis in kind.shape.dim):
            found[value.name] = tuple(axis.dim_value for axis in kind.shape.dim)
    return found


def float_names(model: Any) -> set[str]:
    """Return the names of the float32 values of a graph, its inputs among them."""
    return {value.name for value in inferred_values(model) if value.type.tensor_type.elem_type == FLOAT}


def float_values(model: Any) -> list[str]:
    """Return the float32 values that nodes of a graph give, in order."""
    floats = float_names(model)
    return [name for node in model.graph.node for name in node.output if name in floats]
