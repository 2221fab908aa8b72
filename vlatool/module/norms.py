"""RMS normalisation as ONNX Runtime recognises it."""

from __future__ import annotations

from typing import Any


def divide_by_roots(model: Any) -> int:
    """Write ``x * (1 / sqrt(y))`` as ``x / sqrt(y)``, in place; return how many products became quotients.

    torch's exporter writes the first for ``rsqrt``, and so for every RMSNorm. ONNX Runtime fuses only the second into
    one operator (``SimplifiedLayerNormalization``); OpenVINO fuses both. The two differ by one rounding.

    Args:
        model: an ``onnx_ir.Model``.
    """
    changed = 0
    for graph in (model.graph, *(function.graph for function in model.functions.values())):
        for node in [other_node for other_node in graph if other_node.op_type == "Reciprocal"]:
            products = _only_products(node)
            for product in products:
                other = product.inputs[0 if product.inputs[1] is node.outputs[0] else 1]
                product.op_type = "Div"
                product.replace_input_with(0, other)
                product.replace_input_with(1, node.inputs[0])
            if products:
                graph.remove(node, safe=True)
                changed += len(products)
    return changed


def _only_products(node: Any) -> list[Any]:
    """Return the products that read the reciprocal of a root; nothing when something else reads it too."""
    root, reciprocal = node.inputs[0].producer(), node.outputs[0]
    uses = list(reciprocal.uses())
    if root is None or root.op_type != "Sqrt" or reciprocal.is_graph_output():
        return []
    readers = [use.node for use in uses]
    alone = all(reader.op_type == "Mul" and reader.graph is node.graph for reader in readers)
    return readers if alone and len({id(reader) for reader in readers}) == len(readers) else []
