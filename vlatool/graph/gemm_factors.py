"""Gemms with factors or a transposed input, rewritten as plain products for the stages."""

from __future__ import annotations

from typing import Any

from vlatool.errors import require

FACTORS = ("alpha", "beta", "transA")
"""Attributes of a Gemm beyond a product with a bias."""


def extract_gemm_factors(model: Any) -> int:
    """Move alpha, beta and transA of every Gemm into nodes before it, in place; return the number of changed Gemms.

    Only a Gemm without them is a product with a bias, which stages quantize. ``alpha * A' @ B' + beta * C`` defines the
    operator (ONNX, Gemm-13); alpha is applied to the activations, since weights may not be in memory.

    Args:
        model: An ``onnx_ir.Model``.
    """
    graphs = (model.graph, *(function.graph for function in model.functions.values()))
    return sum(
        _extract(node)
        for graph in graphs
        for node in list(graph.all_nodes())
        if node.op_type == "Gemm" and node.domain in ("", "ai.onnx")
    )


def _extract(node: Any) -> bool:
    values = {name: attribute.value for name, attribute in node.attributes.items()}
    alpha, beta = values.get("alpha", 1.0), values.get("beta", 1.0)
    biased = len(node.inputs) > 2 and node.inputs[2] is not None
    turned = bool(values.get("transA"))
    if alpha == 1.0 and (beta == 1.0 or not biased) and not turned:
        return False
    if turned:
        _insert_before(node, 0, "Transpose", perm=[1, 0])
    if alpha != 1.0:
        _insert_before(node, 0, "Mul", alpha)
    if biased and beta != 1.0:
        _insert_before(node, 2, "Mul", beta)
    for name in FACTORS:
        node.attributes.pop(name, None)
    return True


def _insert_before(node: Any, index: int, kind: str, factor: float | None = None, **attributes: Any) -> None:
    """Insert a node between a node and one of its inputs."""
    ir = require("onnx_ir", "build")
    value = node.inputs[index]
    name = f"{node.outputs[0].name}.{'abc'[index]}.{kind}"
    nodes, inputs = list[Any](), [value]
    if factor is not None:
        dtype = value.dtype or ir.DataType.FLOAT
        tensor = ir.tensor(factor, dtype=dtype, name=f"{name}.factor")
        nodes.append(ir.node("Constant", [], {"value": tensor}, name=f"{name}.factor"))
        inputs.append(nodes[0].outputs[0])
    nodes.append(ir.node(kind, inputs, attributes, name=name))
    for new in nodes:
        new.outputs[0].name = new.name
    nodes[-1].outputs[0].type = value.type
    nodes[-1].outputs[0].shape = value.shape if kind == "Mul" else None
    node.graph.insert_before(node, nodes)
    node.replace_input_with(index, nodes[-1].outputs[0])
