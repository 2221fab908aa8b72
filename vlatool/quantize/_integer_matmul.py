"""Replace QDQ around a MatMul by ONNX Runtime's integer MatMul with float output.

ONNX Runtime fuses ``QuantizeLinear -> DequantizeLinear -> MatMul -> Add`` badly on a CPU: its MatMul-Add fusion makes a
float Gemm that dequantizes the weights at every inference. ``com.microsoft.MatMulIntegerToFloat`` says directly what is
meant: an int8 product, one multiply by both scales, and the bias, with no quantization of the output.
"""

from __future__ import annotations

from typing import Any

from vlatool.errors import require
from vlatool.graph.nodes import reads

DOMAIN = "com.microsoft"


def use_integer_matmul(model: Any) -> int:
    """Rewrite every MatMul of a quantized input and a quantized weight, or of two quantized inputs, in place.

    Args:
        model: An ``onnx.ModelProto`` in QDQ form.

    Returns:
        How many were rewritten.
    """
    onnx = require("onnx", "build")
    graph = model.graph
    producers = {name: node for node in graph.node for name in node.output}
    consumers: dict[str, list[Any]] = {}
    for node in graph.node:
        for name in reads(node):
            consumers.setdefault(name, []).append(node)
    constants = {tensor.name: tensor for tensor in graph.initializer}
    outputs = {value.name for value in graph.output}
    dropped: set[str] = set()
    rewritten = 0
    for index, node in enumerate(list(graph.node)):
        operands = _operands(node, producers, constants)
        if operands is None:
            continue
        bias, add = _bias(node, consumers, constants, outputs, operands["columns"])
        inputs = [*operands["inputs"], *([bias] if bias else [])]
        target = add.output[0] if add else node.output[0]
        made = onnx.helper.make_node("MatMulIntegerToFloat", inputs, [target], name=node.name, domain=DOMAIN)
        graph.node[index].CopyFrom(made)
        if add:
            dropped.add(add.output[0])
        rewritten += 1
    _drop(graph, dropped)
    if rewritten and all(entry.domain != DOMAIN for entry in model.opset_import):
        model.opset_import.append(onnx.helper.make_opsetid(DOMAIN, 1))
    return rewritten


def _operands(node: Any, producers: dict[str, Any], constants: dict[str, Any]) -> dict[str, Any] | None:
    """Return what the integer MatMul takes, or None when the node is not of that pattern."""
    if node.op_type != "MatMul":
        return None
    left, right = producers.get(node.input[0]), producers.get(node.input[1])
    if left is None or right is None or left.op_type != "DequantizeLinear" or right.op_type != "DequantizeLinear":
        return None
    if left.input[0] in constants or len(left.input) < 3 or len(right.input) < 3:
        return None
    inputs = [left.input[0], right.input[0], left.input[1], right.input[1], left.input[2], right.input[2]]
    weight = constants.get(right.input[0])
    if weight is None:  # two activations, as in attention
        scales = [constants.get(name) for name in (left.input[1], right.input[1])]
        whole = all(scale is not None and not [axis for axis in scale.dims if axis != 1] for scale in scales)
        return {"inputs": inputs, "columns": 0} if whole else None
    return {"inputs": inputs, "columns": weight.dims[-1]} if len(weight.dims) == 2 else None


def _bias(
    node: Any, consumers: dict[str, list[Any]], constants: dict[str, Any], outputs: set[str], columns: int
) -> tuple[str, Any]:
    """Return the bias and its Add when that is the only reader of the product."""
    readers = consumers.get(node.output[0], [])
    if len(readers) != 1 or readers[0].op_type != "Add" or node.output[0] in outputs:
        return "", None
    add = readers[0]
    other = add.input[1] if add.input[0] == node.output[0] else add.input[0]
    bias = constants.get(other)
    return (other, add) if bias is not None and list(bias.dims) == [columns] else ("", None)


def _drop(graph: Any, added: set[str]) -> None:
    """Remove the fused Adds, then every node and constant that nobody reads any more."""
    nodes = [node for node in graph.node if not (node.op_type == "Add" and node.output[0] in added)]
    wanted = {value.name for value in graph.output}
    kept = []
    for node in reversed(nodes):
        if any(name in wanted for name in node.output):
            kept.append(node)
            wanted.update(reads(node))
    constants = [tensor for tensor in graph.initializer if tensor.name in wanted]
    del graph.node[:]
    graph.node.extend(reversed(kept))
    del graph.initializer[:]
    graph.initializer.extend(constants)
