"""Reductions that drop their axes, written so that OpenVINO computes them right in an int8 graph.

OpenVINO (2026.4 on x86) gives wrong values, without a word, where a layer reads the quantized output of ReduceMean,
ReduceSum or ReduceMax with ``keepdims=0``. With the axes kept and dropped by a Squeeze it computes what it should.
"""

from __future__ import annotations

from typing import Any

from vlatool.errors import require


def keep_axes(model: Any) -> int:
    """Rewrite every ``Reduce*`` with ``keepdims=0`` as one that keeps its axes, and a Squeeze; return how many."""
    onnx = require("onnx", "build")
    nodes, count = [], 0
    for node in model.graph.node:
        nodes.append(node)
        flags = {item.name: item for item in node.attribute}
        if not node.op_type.startswith("Reduce") or "keepdims" not in flags or flags["keepdims"].i:
            continue
        if "noop_with_empty_axes" in flags and flags["noop_with_empty_axes"].i:
            continue
        count += 1
        flags["keepdims"].i = 1
        given = node.output[0]
        node.output[0] = f"{given}.kept"
        axes = [name for name in node.input[1:2] if name]
        if "axes" in flags:
            axes = [f"{given}.axes"]
            model.graph.initializer.append(
                onnx.helper.make_tensor(axes[0], onnx.TensorProto.INT64, [len(flags["axes"].ints)], flags["axes"].ints)
            )
        name = f"{node.name}/drop_axes"
        nodes.append(onnx.helper.make_node("Squeeze", [node.output[0], *axes], [given], name=name))
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return count
