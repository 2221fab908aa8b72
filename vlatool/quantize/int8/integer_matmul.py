"""Replace QDQ around a MatMul by ONNX Runtime's integer MatMul with float output.

ONNX Runtime fuses ``QuantizeLinear -> DequantizeLinear -> MatMul -> Add`` badly on a CPU: its MatMul-Add fusion makes a
float Gemm that dequantizes the weights at every inference. ``com.microsoft.MatMulIntegerToFloat`` says directly what is
meant: an int8 product, one multiply by both scales, and the bias, with no quantization of the output.
"""

from __future__ import annotations

from typing import Any

from vlatool.graph.onnx_graph import OnnxGraph

DOMAIN = "com.microsoft"


def use_integer_matmul(model: Any) -> int:
    """Rewrite every MatMul of a quantized input and a quantized weight, or of two quantized inputs, in place.

    Args:
        model: An ``onnx.ModelProto`` in QDQ form.

    Returns:
        How many were rewritten.
    """
    graph = OnnxGraph(model)
    fused: list[Any] = []
    rewritten, weights = 0, set[str]()
    for node in model.graph.node:
        operands = _operands(node, graph)
        if not operands:
            continue
        add, bias = _bias(node, graph, operands[1])
        _of_its_own(operands, graph, weights)
        target = (add or node).output[0]
        integer = graph.node("MatMulIntegerToFloat", operands + bias, [target], node.name, domain=DOMAIN)
        if add:
            fused.append(add)
        node.CopyFrom(integer)
        rewritten += 1
    for add in fused:
        model.graph.node.remove(add)
    graph.drop_unread()
    if rewritten and all(entry.domain != DOMAIN for entry in model.opset_import):
        model.opset_import.append(graph.onnx.helper.make_opsetid(DOMAIN, 1))
    return rewritten


def _operands(node: Any, graph: OnnxGraph) -> list[str]:
    """Return what the integer MatMul takes; nothing when the node is not of that pattern."""
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


def _of_its_own(operands: list[str], graph: OnnxGraph, seen: set[str]) -> None:
    """Give a product a copy of a weight that another one has, with its zero point.

    Where products saturate, the option of ONNX Runtime that makes them exact refuses a graph (1.32) in which two such
    products share a weight, and nothing else would be exact.
    """
    weight = operands[1]
    if weight in seen:
        for place in (1, 5):
            name = f"{operands[place]}.{len(graph.constants)}"
            operands[place] = graph.add_tensor(graph.constants[operands[place]], name)
    elif weight in graph.constants:
        seen.add(weight)


def _bias(node: Any, graph: OnnxGraph, weight: str) -> tuple[Any, list[str]]:
    """Return the Add of a bias and the bias, when that is the only reader of the product with a weight."""
    value, columns = node.output[0], graph.constants[weight].dims[-1] if weight in graph.constants else 0
    readers = graph.readers[value]
    if len(readers) == 1 and readers[0].op_type == "Add" and value not in graph.outputs:
        bias = next(name for name in readers[0].input if name != value)
        if bias in graph.constants and list(graph.constants[bias].dims) == [columns]:
            return readers[0], [bias]
    return None, []
