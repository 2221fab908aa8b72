"""Random numbers inside a graph, which can neither be seeded nor compared with torch."""

from __future__ import annotations

import ast
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError
from vlatool.graph.nodes import inner_nodes, with_inner_nodes

DISTRIBUTIONS = {
    "RandomNormal": "normal", "RandomNormalLike": "normal", "RandomUniform": "uniform", "RandomUniformLike": "uniform",
    "Bernoulli": "uniform", "Multinomial": "uniform",
}  # fmt: skip
"""ONNX operator that draws random numbers -> distribution of the equivalent noise of a program."""
TRAINING_MODE_INPUT = {"Dropout": 2, "BiasDropout": 4, "BitmaskDropout": 2, "BitmaskBiasDropout": 4}
"""Dropout operator -> index of its input ``training_mode``, which makes it draw."""
SAMPLING_OPS = ("Sampling",)
"""Operators of ONNX Runtime with random outputs."""
DOMAINS = ("", "ai.onnx", "com.microsoft")
"""Domains of operators; other domains hold functions of the file, whose own nodes are checked."""
BOOL = 9
"""``onnx.TensorProto.BOOL``."""
GUIDE_HINT = 'see "Noise" in docs/guides/your-own-policy.md'


def refuse_random_ops(model: Any, graph: str) -> None:
    """Refuse a graph that draws its own random numbers.

    Args:
        model: An ``onnx_ir.Model``.

    Raises:
        GraphError: with number and location of the draws, and how to declare the noise instead.
    """
    dropping = [node for node in model.graph.all_nodes() if _drops(node)]
    if dropping:
        raise GraphError(
            f"forward() of '{graph}' draws random numbers, {_count_text(dropping)} an inference: dropout is in "
            "training mode.",
            "let make() return a module in evaluation mode, and forward() call F.dropout(..., training=self.training)",
        )
    draws = [node for node in model.graph.all_nodes() if node.op_type in DISTRIBUTIONS]
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
        f"forward() of '{graph}' draws random numbers, {_count_text(draws)} an inference{where}: such a graph can "
        "neither be compared with torch nor reproduced from a seed.",
        "let forward() take them as an input, and declare that in the program of policy.yaml: "
        f"{_noise_declaration(draws, drawn)}{index}; {GUIDE_HINT}",
    )


def _drops(node: Any) -> bool:
    """Return whether a node of an ``onnx_ir.Model`` is a dropout that nothing constant switches off."""
    index = TRAINING_MODE_INPUT.get(node.op_type, 0)
    mode = node.inputs[index] if index and len(node.inputs) > index else None
    return mode is not None and (mode.const_value is None or bool(mode.const_value.numpy().any()))


def refuse_random_file(model: Any, path: Path) -> None:
    """Refuse a user's ONNX file that draws its own random numbers, including in branches, loops and functions.

    Args:
        model: An ``onnx.ModelProto``.

    Raises:
        GraphError: with the operators, and how to declare the noise instead.
    """
    shapes = {value.name: _static(value) for value in (*model.graph.value_info, *model.graph.output)}
    draws = _random_nodes(model)
    if not draws:
        return
    operators = ", ".join(dict.fromkeys(node.op_type for node in draws))
    if not all(node.op_type in DISTRIBUTIONS for node in draws):
        raise GraphError(
            f"{path} draws random numbers, {_count_text(draws)} an inference ({operators}).",
            "export it in evaluation mode: torch's module.eval() switches dropout off",
        )
    index = "; each of them takes its part of the noise" if len(draws) > 1 else ""
    raise GraphError(
        f"{path} draws random numbers, {_count_text(draws)} an inference ({operators}): such a graph can neither be "
        "reproduced from a seed nor verified on another machine.",
        "export the file with an input instead of the draws, and declare that input in the policy.yaml beside it: "
        "program: [{graph: main, gives: {...}, "
        f"{_noise_declaration(draws, [shapes.get(node.output[0], ()) for node in draws])}}}]{index}; {GUIDE_HINT}",
    )


def random_operators(model: Any) -> tuple[str, ...]:
    """Return the operators of an ``onnx.ModelProto`` that draw random numbers, including branches, loops and functions.

    A session's numbers follow from its seed, so an observer of them could count inferences.
    """
    return tuple(dict.fromkeys(node.op_type for node in _random_nodes(model)))


def _random_nodes(model: Any) -> list[Any]:
    """Return the nodes that draw random numbers.

    A dropout counts unless a constant of its own graph switches it off: any other input may be computed, and inside a
    branch or a function the same name may belong to another value.
    """
    graph, off = model.graph, _false_constants(model.graph)
    inside = [inner for node in graph.node for inner in inner_nodes(node)]
    inside += [node for value in model.functions for node in with_inner_nodes(value.node)]
    outer = [node for node in graph.node if _is_random(node, off)]
    return outer + [node for node in inside if _is_random(node, set())]


def _false_constants(graph: Any) -> set[str]:
    """Return the names of constants of a graph that are false and cannot be fed."""
    fed = {value.name for value in graph.input}
    held = {tensor.name: tensor for tensor in graph.initializer if tensor.name not in fed}
    held |= {node.output[0]: item.t for node in graph.node if node.op_type == "Constant" for item in node.attribute
             if item.name == "value"}  # fmt: skip
    return {
        name
        for name, tensor in held.items()
        if tensor.data_type == BOOL and not (tensor.external_data or any(tensor.raw_data) or any(tensor.int32_data))
    }


def _is_random(node: Any, off: Set[str]) -> bool:
    """Return whether a node draws random numbers; ``off``: values that switch a dropout off."""
    index = TRAINING_MODE_INPUT.get(node.op_type)
    dropping = index is not None and len(node.input) > index and node.input[index] not in {"", *off}
    return node.domain in DOMAINS and (dropping or node.op_type in DISTRIBUTIONS or node.op_type in SAMPLING_OPS)


def _static(value: Any) -> tuple[int, ...]:
    return tuple(axis.dim_value for axis in value.type.tensor_type.shape.dim if axis.dim_value > 0)


def _count_text(nodes: Sequence[Any]) -> str:
    return f"{len(nodes)} times" if len(nodes) > 1 else "once"


def _noise_declaration(nodes: Sequence[Any], drawn: Sequence[tuple[int, ...]]) -> str:
    """Return the noise of a program that replaces these nodes; ``drawn``: the shape of each."""
    distribution = DISTRIBUTIONS[nodes[0].op_type]
    span = " (on [-1, 1))" if distribution == "uniform" else ""
    noise = f"{{shape: {_shape(drawn)}, distribution: {distribution}}}"
    return f"feeds: {{..., noise: noise}}, noise: {{noise: {noise}}}{span}"


def _shape(shapes: Sequence[tuple[int, ...]]) -> str:
    """Return the shape of all draws as one array; that of the largest where they differ or are unknown."""
    largest = max(shapes, key=len)
    axes = [len(shapes), *largest] if len(shapes) > 1 else [*largest]
    return str(axes) if largest else "[...]"


def _scope(node: Any) -> str:
    """Return the torch module that a node comes from; empty for the policy itself."""
    scopes = node.metadata_props.get("pkg.torch.onnx.name_scopes", "")
    modules = ast.literal_eval(scopes) if scopes.startswith("[") else []
    return str(modules[-2]) if len(modules) > 1 else ""
