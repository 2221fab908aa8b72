"""Reductions that drop their axes, rewritten so that OpenVINO computes them correctly in an int8 graph.

OpenVINO (2026.4 on x86) silently returns wrong values where a layer reads the quantized output of ReduceMean, ReduceSum
or ReduceMax with ``keepdims=0``. With kept axes and a Squeeze after them the values are right.
"""

from __future__ import annotations

from typing import Any

from vlatool.graph.onnx_graph import OnnxGraph


def keep_reduced_axes(model: Any) -> int:
    """Rewrite every ``Reduce*`` with ``keepdims=0`` as one that keeps its axes, and a Squeeze; return their number."""
    graph, nodes, count = OnnxGraph(model), [], 0
    for node in model.graph.node:
        nodes.append(node)
        options = {item.name: item for item in node.attribute}
        if not node.op_type.startswith("Reduce") or "keepdims" not in options or options["keepdims"].i:
            continue
        if "noop_with_empty_axes" in options and options["noop_with_empty_axes"].i:
            continue
        count += 1
        options["keepdims"].i = 1
        output = node.output[0]
        node.output[0] = f"{output}.kept"
        axes = [name for name in node.input[1:2] if name]
        if "axes" in options:
            ints = options["axes"].ints
            kind = graph.onnx.TensorProto.INT64
            axes = [graph.add_tensor(graph.onnx.helper.make_tensor(f"{output}.axes", kind, [len(ints)], ints))]
        nodes.append(graph.node("Squeeze", [node.output[0], *axes], [output], f"{node.name}/drop_axes"))
    graph.replace_nodes(nodes)
    return count
