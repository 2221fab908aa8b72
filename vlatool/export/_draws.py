"""Random numbers inside a graph: neither a seed nor a comparison with torch reaches them."""

from __future__ import annotations

import ast
from typing import Any

from vlatool.errors import GraphError

DRAWING = {
    "RandomNormal": "normal", "RandomNormalLike": "normal", "RandomUniform": "uniform", "RandomUniformLike": "uniform",
    "Bernoulli": "uniform", "Multinomial": "uniform",
}  # fmt: skip
"""ONNX operator that draws -> what a program would draw in its place."""


def refuse_draws(model: Any, graph: str) -> None:
    """Refuse a graph that draws its own random numbers.

    Args:
        model: An ``onnx_ir.Model``.
        graph: Its name in the program.

    Raises:
        GraphError: saying how often and where it draws, and how to declare the noise instead.
    """
    found = [node for node in model.graph.all_nodes() if node.op_type in DRAWING]
    if not found:
        return
    scopes = dict.fromkeys(scope for node in found if (scope := _scope(node)))
    where = f" in {', '.join(list(scopes)[:3])}" if scopes else ""
    times = f"{len(found)} times" if len(found) > 1 else "once"
    shape = _shape(found)
    index = "; forward() takes noise[i] in turn i" if len(found) > 1 else ""
    distribution = DRAWING[found[0].op_type]
    span = " (on [-1, 1))" if distribution == "uniform" else ""
    raise GraphError(
        f"forward() of '{graph}' draws random numbers, {times} an inference{where}: a graph that draws its own can "
        "neither be compared with torch nor repeated from a seed.",
        "let forward() take them as an input, and declare that in the program of policy.yaml: "
        f"feeds: {{..., noise: noise}}, noise: {{noise: {{shape: {shape}, distribution: {distribution}}}}}{span}"
        f'{index}; see "Noise" in docs/guides/your-own-policy.md',
    )


def _shape(nodes: list[Any]) -> str:
    """Return the shape of all draws as one array; of the largest, where they differ or are not known."""
    shapes = [
        tuple(axis for axis in node.outputs[0].shape if isinstance(axis, int)) if node.outputs[0].shape else ()
        for node in nodes
    ]
    largest = max(shapes, key=len)
    axes = [len(nodes), *largest] if len(nodes) > 1 else [*largest]
    return str(axes) if largest else "[...]"


def _scope(node: Any) -> str:
    """Return the torch module that a node comes from; empty for the policy itself."""
    scopes = node.metadata_props.get("pkg.torch.onnx.name_scopes", "")
    found = ast.literal_eval(scopes) if scopes.startswith("[") else []
    return str(found[-2]) if len(found) > 1 else ""
