"""Random numbers inside a graph: neither a seed nor a comparison with torch reaches them."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence, Set
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError
from vlatool.graph.nodes import nodes_inside

DRAWING = {
    "RandomNormal": "normal", "RandomNormalLike": "normal", "RandomUniform": "uniform", "RandomUniformLike": "uniform",
    "Bernoulli": "uniform", "Multinomial": "uniform",
}  # fmt: skip
"""ONNX operator that draws -> what a program would draw in its place."""
DROPPING = {"Dropout": 2, "BiasDropout": 4, "BitmaskDropout": 2, "BitmaskBiasDropout": 4}
"""Operator that draws where its input of this number, ``training_mode``, says so."""
SAMPLING = ("Sampling",)
"""Operators of ONNX Runtime that draw what they give."""
DOMAINS = ("", "ai.onnx", "com.microsoft")
"""Of operators; a name in any other one is of a function in the file, whose own nodes say what it does."""
BOOL = 9
"""``onnx.TensorProto.BOOL``."""
GUIDE = 'see "Noise" in docs/guides/your-own-policy.md'


def refuse_draws(model: Any, graph: str) -> None:
    """Refuse a graph that draws its own random numbers.

    Args:
        model: An ``onnx_ir.Model``.
        graph: Its name in the program.

    Raises:
        GraphError: saying how often and where it draws, and how to declare the noise instead.
    """
    draws = [node for node in model.graph.all_nodes() if node.op_type in DRAWING]
    if not draws:
        return
    scopes = dict.fromkeys(scope for node in draws if (scope := _scope(node)))
    where = f" in {', '.join(list(scopes)[:3])}" if scopes else ""
    drawn = [
        tuple(axis for axis in node.outputs[0].shape if isinstance(axis, int)) if node.outputs[0].shape else ()
        for node in draws
    ]
    index = "; forward() takes noise[i] in turn i" if len(draws) > 1 else ""
    raise GraphError(
        f"forward() of '{graph}' draws random numbers, {_times(draws)} an inference{where}: a graph that draws its own "
        "can neither be compared with torch nor repeated from a seed.",
        "let forward() take them as an input, and declare that in the program of policy.yaml: "
        f"{_declared(draws, drawn)}{index}; {GUIDE}",
    )


def refuse_drawing_file(model: Any, path: Path) -> None:
    """Refuse an ONNX file of the user that draws its own random numbers, be it in a branch, a loop or a function.

    Args:
        model: An ``onnx.ModelProto``.
        path: The file.

    Raises:
        GraphError: naming the operators, and how to declare the noise instead.
    """
    shapes = {value.name: _static(value) for value in (*model.graph.value_info, *model.graph.output)}
    draws = _drawing_nodes(model)
    if not draws:
        return
    operators = ", ".join(dict.fromkeys(node.op_type for node in draws))
    if not all(node.op_type in DRAWING for node in draws):
        raise GraphError(
            f"{path} draws random numbers, {_times(draws)} an inference ({operators}).",
            "export it as it acts, not as it is trained: torch's module.eval() switches dropout off",
        )
    index = "; each of them takes its part of the noise" if len(draws) > 1 else ""
    raise GraphError(
        f"{path} draws random numbers, {_times(draws)} an inference ({operators}): a graph that draws its own can "
        "neither be repeated from a seed nor be verified on another machine.",
        "export the file with an input in the place of the draws, and declare that in the policy.yaml beside it: "
        "program: [{graph: main, gives: {...}, "
        f"{_declared(draws, [shapes.get(node.output[0], ()) for node in draws])}}}]{index}; {GUIDE}",
    )


def drawing(model: Any) -> tuple[str, ...]:
    """Return the operators of an ``onnx.ModelProto`` that draw random numbers, also in branches, loops and functions.

    The numbers of a session follow from their seed: whoever knows them counts inferences with them.
    """
    return tuple(dict.fromkeys(node.op_type for node in _drawing_nodes(model)))


def _drawing_nodes(model: Any) -> list[Any]:
    """Return the nodes that draw.

    A dropout counts unless a constant of the graph that it is in switches it off: anything else may be computed, and in
    a branch or a function the same name may be of another value.
    """
    graph, off = model.graph, _false_constants(model.graph)
    inside = [inner for node in graph.node for inner in nodes_inside(node)]
    inside += [node for value in model.functions for node in _nodes(value.node)]
    return [*(node for node in graph.node if _draws(node, off)), *(node for node in inside if _draws(node, set()))]


def _false_constants(graph: Any) -> set[str]:
    """Return the names of constants of a graph that are false, whatever is fed."""
    fed = {value.name for value in graph.input}
    held = {tensor.name: tensor for tensor in graph.initializer if tensor.name not in fed}
    held |= {node.output[0]: item.t for node in graph.node if node.op_type == "Constant" for item in node.attribute
             if item.name == "value"}  # fmt: skip
    return {
        name
        for name, tensor in held.items()
        if tensor.data_type == BOOL and not (tensor.external_data or any(tensor.raw_data) or any(tensor.int32_data))
    }


def _draws(node: Any, off: Set[str]) -> bool:
    """Return whether a node draws; ``off``: values that switch a dropout off."""
    place = DROPPING.get(node.op_type)
    dropping = place is not None and len(node.input) > place and node.input[place] not in {"", *off}
    return node.domain in DOMAINS and (dropping or node.op_type in DRAWING or node.op_type in SAMPLING)


def _nodes(nodes: Sequence[Any]) -> Iterator[Any]:
    """Yield nodes and those of the graphs inside of them."""
    for node in nodes:
        yield node
        yield from nodes_inside(node)


def _static(value: Any) -> tuple[int, ...]:
    return tuple(axis.dim_value for axis in value.type.tensor_type.shape.dim if axis.dim_value > 0)


def _times(nodes: Sequence[Any]) -> str:
    return f"{len(nodes)} times" if len(nodes) > 1 else "once"


def _declared(nodes: Sequence[Any], drawn: Sequence[tuple[int, ...]]) -> str:
    """Return how the program of a policy draws what these nodes do; ``drawn``: the shape of each."""
    distribution = DRAWING[nodes[0].op_type]
    span = " (on [-1, 1))" if distribution == "uniform" else ""
    noise = f"{{shape: {_shape(drawn)}, distribution: {distribution}}}"
    return f"feeds: {{..., noise: noise}}, noise: {{noise: {noise}}}{span}"


def _shape(shapes: Sequence[tuple[int, ...]]) -> str:
    """Return the shape of all draws as one array; of the largest, where they differ or are not known."""
    largest = max(shapes, key=len)
    axes = [len(shapes), *largest] if len(shapes) > 1 else [*largest]
    return str(axes) if largest else "[...]"


def _scope(node: Any) -> str:
    """Return the torch module that a node comes from; empty for the policy itself."""
    scopes = node.metadata_props.get("pkg.torch.onnx.name_scopes", "")
    modules = ast.literal_eval(scopes) if scopes.startswith("[") else []
    return str(modules[-2]) if len(modules) > 1 else ""
