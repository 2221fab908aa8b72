"""Constant folding at export: splits and transposes of weights are computed once."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlatool.errors import require


def fold_weights(model: Any) -> int:
    """Replace each ``Split`` and ``Transpose`` of a weight by its result, in place; return how many nodes are gone.

    ``nn.MultiheadAttention`` over a context cuts its projections out of one weight, and torch's exporter leaves that in
    the graph. A product whose weight is computed is not a layer to what quantizes or counts.

    Args:
        model: an ``onnx_ir.Model`` whose weights are in memory.
    """
    ir = require("onnx_ir", "build")
    folded = 0
    for node in list(model.graph):
        weight = node.inputs[0] if node.inputs else None
        if node.domain or weight is None or not weight.is_initializer() or weight.is_graph_input():
            continue
        if any(value.is_graph_output() for value in node.outputs):
            continue
        parts = _parts(node, weight)
        if parts is None:
            continue
        for number, (value, part) in enumerate(zip(node.outputs, parts, strict=True)):
            name = f"{weight.name}.{number}" if len(parts) > 1 else f"{weight.name}.turned"
            new = ir.Value(name=_free(model.graph, name), shape=ir.Shape(part.shape), type=weight.type)
            new.const_value = ir.tensor(np.ascontiguousarray(part), name=new.name)
            model.graph.register_initializer(new)
            ir.convenience.replace_all_uses_with(value, new)
        model.graph.remove(node, safe=True)
        if not list(weight.uses()) and not weight.is_graph_output():
            del model.graph.initializers[weight.name]
        folded += 1
    return folded


def _parts(node: Any, weight: Any) -> list[Any] | None:
    """Return what a node makes of a weight; None when it does something else, or with what only a run knows."""
    if node.op_type == "Transpose":
        turned = node.attributes.get("perm")
        return [np.transpose(weight.const_value.numpy(), turned.as_ints() if turned else None)]
    if node.op_type != "Split":
        return None
    along = node.attributes.get("axis")
    axis = along.as_int() if along else 0
    sizes = node.inputs[1] if len(node.inputs) > 1 else None
    if sizes is None:
        length = -(-weight.shape[axis] // len(node.outputs))
        ends = [length * number for number in range(1, len(node.outputs))]
    elif sizes.is_initializer() and not sizes.is_graph_input():
        ends = np.cumsum(sizes.const_value.numpy())[:-1].tolist()
    else:
        return None
    return list(np.split(weight.const_value.numpy(), ends, axis))


def _free(graph: Any, name: str) -> str:
    while name in graph.initializers:
        name += "_"
    return name
