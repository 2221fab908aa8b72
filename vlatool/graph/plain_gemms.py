"""Gemms that scale or turn what they multiply, as the stages read them."""

from __future__ import annotations

from typing import Any

from vlatool.errors import require

FACTORS = ("alpha", "beta", "transA")
"""Attributes of a Gemm that is more than a product with a bias."""


def plain_gemms(model: Any) -> int:
    """Give every Gemm alpha and beta of 1 and no transA, in place: nodes before it scale and turn; return how many.

    Only such a Gemm is a product with a bias, which is what stages quantize. ``alpha * A' @ B' + beta * C`` is the
    definition of the operator (ONNX, Gemm-13); alpha is applied to the activations, since weights may not be in memory.

    Args:
        model: An ``onnx_ir.Model``.
    """
    graphs = (model.graph, *(function.graph for function in model.functions.values()))
    return sum(
        _made_plain(node)
        for graph in graphs
        for node in list(graph.all_nodes())
        if node.op_type == "Gemm" and node.domain in ("", "ai.onnx")
    )


def _made_plain(node: Any) -> bool:
    values = {name: attribute.value for name, attribute in node.attributes.items()}
    alpha, beta = values.get("alpha", 1.0), values.get("beta", 1.0)
    biased = len(node.inputs) > 2 and node.inputs[2] is not None
    turned = bool(values.get("transA"))
    if alpha == 1.0 and (beta == 1.0 or not biased) and not turned:
        return False
    if turned:
        _before(node, 0, "Transpose", perm=[1, 0])
    if alpha != 1.0:
        _before(node, 0, "Mul", alpha)
    if biased and beta != 1.0:
        _before(node, 2, "Mul", beta)
    for name in FACTORS:
        node.attributes.pop(name, None)
    return True


def _before(node: Any, place: int, kind: str, factor: float | None = None, **attributes: Any) -> None:
    """Put a node between an input of another one and what gives it."""
    ir = require("onnx_ir", "build")
    value = node.inputs[place]
    name = f"{node.outputs[0].name}.{'abc'[place]}.{kind}"
    nodes, inputs = list[Any](), [value]
    if factor is not None:
        dtype = value.dtype or ir.DataType.FLOAT
        tensor = ir.tensor(factor, dtype=dtype, name=f"{name}.factor")
        nodes.append(ir.node("Constant", [], {"value": tensor}, name=f"{name}.factor"))
        inputs.append(nodes[0].outputs[0])
    nodes.append(ir.node(kind, inputs, attributes, name=name))
    for made in nodes:
        made.outputs[0].name = made.name
    nodes[-1].outputs[0].type = value.type
    nodes[-1].outputs[0].shape = value.shape if kind == "Mul" else None
    node.graph.insert_before(node, nodes)
    node.replace_input_with(place, nodes[-1].outputs[0])
