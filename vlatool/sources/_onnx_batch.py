"""A batch axis for an ONNX file whose inputs have none: every tensor of a policy begins with one."""

from __future__ import annotations

from typing import Any

from vlatool.errors import require
from vlatool.graph.nodes import free_name


def add_batch_axes(model: Any) -> list[str]:
    """Put an axis of 1 in front of inputs that begin with another length, and then of such outputs, in place.

    What such an input takes is one observation whole: a window of frames, or a vector without a batch.

    Args:
        model: A ``ModelProto`` whose free first axes were fixed.

    Returns:
        Names of the inputs and outputs that have a further axis.
    """
    graph = model.graph
    stored = {tensor.name for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in stored and _lacks_batch(value)]
    if not inputs:
        return []
    outputs = [value for value in graph.output if _lacks_batch(value)]
    helper = require("onnx.helper", "build")
    taken = stored | {name for node in graph.node for name in (*node.input, *node.output)}
    axes = free_name("batch_axis", 0, taken)
    graph.initializer.append(helper.make_tensor(axes, 7, [1], [0]))
    before, after = [], []
    for value in inputs:
        inner = free_name(f"{value.name}_observed", 0, taken)
        _rename_reads(graph, value.name, inner)
        before.append(helper.make_node("Squeeze", [value.name, axes], [inner], f"{value.name}/Squeeze"))
    for value in outputs:
        inner = free_name(f"{value.name}_given", 0, taken)
        _rename_reads(graph, value.name, inner)
        for node in graph.node:
            node.output[:] = [inner if name == value.name else name for name in node.output]
        after.append(helper.make_node("Unsqueeze", [inner, axes], [value.name], f"{value.name}/Unsqueeze"))
    nodes = [*before, *graph.node, *after]
    del graph.node[:]
    graph.node.extend(nodes)
    for value in (*inputs, *outputs):
        _put_axis(value)
    return [value.name for value in (*inputs, *outputs)]


def _lacks_batch(value: Any) -> bool:
    """Whether a tensor begins with an axis of a length that is not 1."""
    axes = value.type.tensor_type.shape.dim
    return bool(axes) and axes[0].HasField("dim_value") and axes[0].dim_value > 1


def _put_axis(value: Any) -> None:
    shape = value.type.tensor_type.shape
    axes = list(shape.dim)
    del shape.dim[:]
    shape.dim.add().dim_value = 1
    shape.dim.extend(axes)


def _rename_reads(graph: Any, old: str, new: str) -> None:
    """Rename a value wherever nodes of a graph, or of its subgraphs, read it."""
    for node in graph.node:
        node.input[:] = [new if name == old else name for name in node.input]
        for attribute in node.attribute:
            for inner in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                _rename_reads(inner, old, new)
