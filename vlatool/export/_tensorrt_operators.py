"""Operators and types that TensorRT's ONNX parser takes, as its makers publish them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError
from vlatool.graph.nodes import subgraphs, with_inner_nodes
from vlatool.graph.onnx_graph import DOMAINS, OnnxGraph, type_name

LIST = Path(__file__).parent / "data/tensorrt.json"
CASTS = {"float64": "float32"}
"""Types that the parser computes in another one."""
DATA_INPUT = {"Where": 1}
"""Operator -> index of the input whose type counts; the first of all others."""
OWN_TYPES = ("QuantizeLinear", "DequantizeLinear", "Constant", "Shape", "Size", "Range", "ConstantOfShape")
"""Operators whose types are checked otherwise, or that take any."""


@cache
def support_list() -> dict[str, Any]:
    """Return the list: ``tensorrt``, ``opset``, ``ir_version``, ``source``, ``operators``, ``constant_inputs``."""
    content: dict[str, Any] = json.loads(LIST.read_text(encoding="utf-8"))
    return content


def refuse_unsupported(model: Any, graph: str, fix: str, *, types: bool = True) -> None:
    """Refuse a graph with an operator, a type or a computed setting that the parser does not take.

    Args:
        model: an ``onnx.ModelProto``; its constants may be without values.
        types: whether types count, which rewriting may change.

    Raises:
        GraphError: naming each of them.
    """
    problems = list(dict.fromkeys(_problems(model, types)))
    if problems:
        known = support_list()
        raise GraphError(
            f"TensorRT's parser does not take the graph '{graph}': {'; '.join(problems)} (list for TensorRT "
            f"{known['tensorrt']}).",
            fix,
        )


def _problems(model: Any, typed: bool) -> Iterator[str]:
    known, graph = support_list(), OnnxGraph(model)
    constants = {name: tensor.data_type for name, tensor in graph.constants.items()}
    types = {**graph.types, **constants} if typed else {}
    stored = set(graph.constants) | _constants(model.graph)
    for node in with_inner_nodes(model.graph.node):
        name = node.op_type if node.domain in DOMAINS else f"{node.domain}.{node.op_type}"
        allowed = known["operators"].get(name) if node.domain in DOMAINS else None
        if not allowed:
            yield f"operator {name}"
            continue
        index = DATA_INPUT.get(name, 0)
        kind = type_name(types.get(node.input[index], 0)) if len(node.input) > index else ""
        if name not in OWN_TYPES and kind and kind != "undefined" and CASTS.get(kind, kind) not in allowed:
            yield f"{name} of {kind}"
        for number in known["constant_inputs"].get(name, ()):
            if len(node.input) > number and node.input[number] and node.input[number] not in stored:
                yield f"{name} whose input {number} is computed"


def _constants(graph: Any) -> set[str]:
    """Return the outputs of Constant nodes, and the constants of inner graphs."""
    nodes = list(with_inner_nodes(graph.node))
    inner = {tensor.name for node in nodes for part in subgraphs(node) for tensor in part.initializer}
    return inner | {name for node in nodes if node.op_type == "Constant" for name in node.output}
