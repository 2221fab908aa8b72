"""A batch axis for an ONNX file whose inputs have none: every tensor of a policy begins with one."""

from __future__ import annotations

from typing import Any

from vlatool.errors import require
from vlatool.graph.nodes import rename_reads, unique_name

AXES_AS_INPUT = 13
"""Opset from which Squeeze and Unsqueeze have their axes as an input."""


def add_batch_axes(model: Any, opset: int) -> list[str]:
    """Put an axis of 1 in front of inputs that begin with another length, and then of such outputs, in place.

    What such an input takes is one observation whole: a window of frames, or a vector without a batch. An action
    without axes gets one in any case.

    Args:
        model: A ``ModelProto`` whose free first axes were fixed.

    Returns:
        Names of the inputs and outputs that have a further axis.
    """
    graph = model.graph
    stored = {tensor.name for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in stored and _lacks_batch(value)]
    bare = [value for value in graph.output[:1] if value.type.tensor_type.HasField("shape") and not _axes(value)]
    outputs = [value for value in graph.output if inputs and _lacks_batch(value)] + bare
    if not inputs and not outputs:
        return []
    taken = stored | {name for node in graph.node for name in (*node.input, *node.output)}
    axes = unique_name("batch_axis", 0, taken)
    before, after = [], []
    for value in inputs:
        inner = unique_name(f"{value.name}_observed", 0, taken)
        rename_reads(graph, value.name, inner)
        before.append(_moved("Squeeze", value.name, inner, f"{value.name}/Squeeze", axes, opset))
    for value in outputs:
        inner = unique_name(f"{value.name}_given", 0, taken)
        rename_reads(graph, value.name, inner)
        for node in graph.node:
            node.output[:] = [inner if name == value.name else name for name in node.output]
        after.append(_moved("Unsqueeze", inner, value.name, f"{value.name}/Unsqueeze", axes, opset))
    nodes = [*before, *graph.node, *after]
    del graph.node[:]
    graph.node.extend(nodes)
    if opset >= AXES_AS_INPUT:
        graph.initializer.append(require("onnx.helper", "build").make_tensor(axes, 7, [1], [0]))
    for value in (*inputs, *outputs):
        _put_axis(value)
    return [value.name for value in (*inputs, *outputs)]


def _moved(kind: str, given: str, gives: str, name: str, axes: str, opset: int) -> Any:
    """Return a Squeeze or Unsqueeze of the first axis, as it is written in an opset."""
    make = require("onnx.helper", "build").make_node
    if opset < AXES_AS_INPUT:
        return make(kind, [given], [gives], name, axes=[0])
    return make(kind, [given, axes], [gives], name)


def _axes(value: Any) -> Any:
    return value.type.tensor_type.shape.dim


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
