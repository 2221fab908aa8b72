"""Replace QDQ around a MatMul by ONNX Runtime's integer MatMul with float output.

ONNX Runtime fuses ``QuantizeLinear -> DequantizeLinear -> MatMul -> Add`` badly on a CPU: its MatMul-Add fusion makes a
float Gemm that dequantizes the weights at every inference. ``com.microsoft.MatMulIntegerToFloat`` expresses the
intention directly: an int8 product, one multiplication by both scales, and the bias, without quantizing the output.
"""

from __future__ import annotations

from typing import Any

from vlatool.graph.onnx_graph import OnnxGraph

ORT_DOMAIN = "com.microsoft"


def use_integer_matmul(model: Any) -> int:
    """Rewrite every MatMul of a quantized input and a quantized weight, or of two quantized inputs, in place.

    Args:
        model: An ``onnx.ModelProto`` in QDQ form.

    Returns:
        Number of rewritten nodes.
    """
    graph = OnnxGraph(model)
    fused: list[Any] = []
    rewritten, weights = 0, set[str]()
    for node in model.graph.node:
        operands = _operands(node, graph)
        if not operands:
            continue
        add, bias = _bias(node, graph, operands[1])
        _unshare_weight(operands, graph, weights)
        target = (add or node).output[0]
        integer = graph.node("MatMulIntegerToFloat", operands + bias, [target], node.name, domain=ORT_DOMAIN)
        if add:
            fused.append(add)
        node.CopyFrom(integer)
        rewritten += 1
    for add in fused:
        model.graph.node.remove(add)
    graph.drop_unread()
    if rewritten and all(entry.domain != ORT_DOMAIN for entry in model.opset_import):
        model.opset_import.append(graph.onnx.helper.make_opsetid(ORT_DOMAIN, 1))
    return rewritten


def _operands(node: Any, graph: OnnxGraph) -> list[str]:
    """Return the operands of the integer MatMul; empty when the node does not match the pattern."""
    pairs = [graph.producers[name] for name in node.input if node.op_type == "MatMul" and name in graph.producers]
    pairs = [pair for pair in pairs if pair.op_type == "DequantizeLinear" and len(pair.input) > 2]
    if len(pairs) < 2 or pairs[0].input[0] in graph.constants:
        return []
    left, right = (pair.input for pair in pairs)
    if right[0] in graph.constants:
        fits = len(graph.constants[right[0]].dims) == 2
    else:  # two activations, as in attention
        fits = graph.is_scalar(left[1]) and graph.is_scalar(right[1])
    return [left[0], right[0], left[1], right[1], left[2], right[2]] if fits else []


def _unshare_weight(operands: list[str], graph: OnnxGraph, used: set[str]) -> None:
    """Copy a weight and its zero point for a product that shares them with another one.

    Where products saturate, the only option of ONNX Runtime (1.32) that makes them exact refuses a graph in which two
    such products share a weight.
    """
    weight = operands[1]
    if weight in used:
        for index in (1, 5):
            name = f"{operands[index]}.{len(graph.constants)}"
            operands[index] = graph.add_tensor(graph.constants[operands[index]], name)
    elif weight in graph.constants:
        used.add(weight)


def _bias(node: Any, graph: OnnxGraph, weight: str) -> tuple[Any, list[str]]:
    """Return the Add of a bias and the bias, when that Add is the only reader of the product."""
    value, columns = node.output[0], graph.constants[weight].dims[-1] if weight in graph.constants else 0
    readers = graph.readers[value]
    if len(readers) == 1 and readers[0].op_type == "Add" and value not in graph.outputs:
        bias = next(name for name in readers[0].input if name != value)
        if bias in graph.constants and list(graph.constants[bias].dims) == [columns]:
            return readers[0], [bias]
    return None, []
