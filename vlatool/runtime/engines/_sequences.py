"""Where OpenVINO would crash: a sum behind products of matrices for which it generates one kernel."""

from __future__ import annotations

from typing import Any

MATRIX = 2
"""Axes of what such a kernel multiplies."""
SEQUENCE = 2
"""Products from which on it is generated."""


def joins_a_sequence(model: Any) -> bool:
    """Return whether two values meet, one of which comes from a sequence of products of matrices.

    OpenVINO (2026.4) generates one kernel for Linear, GELU, Linear on matrices. Where the sum of a residual connection
    behind it does not fit into that kernel, as with a bias in both, it reads the kernel as one that it could still add
    to, and a null pointer ends the process.
    """
    products: dict[str, int] = {}  # of what varies with an input: how many products without anything else between
    for node in model.get_ordered_ops():
        name = node.get_friendly_name()
        inputs = [port.get_node().get_friendly_name() for port in node.input_values()]
        varying = [value for value in inputs if value in products]
        if node.get_type_name() == "Parameter":
            products[name] = 0
        elif varying:
            known = max(products[value] for value in varying)
            products[name] = _continued(node, known, inputs[-1] not in products)
            if len(varying) > 1 and known >= SEQUENCE and products[name]:
                return True
    return False


def _continued(node: Any, known: int, constant: bool) -> int:
    """Return the products up to and with a node: 0 where it cannot be a part of such a kernel."""
    shapes = [port.get_partial_shape() for port in (*node.input_values(), *node.outputs())]
    if any(shape.rank.is_dynamic for shape in shapes) or len(shapes[-1]) > MATRIX:
        return 0
    if node.get_type_name() == "MatMul":
        return known + 1 if constant else 0
    return known if any(shape == shapes[-1] for shape in shapes[:-1]) else 0
