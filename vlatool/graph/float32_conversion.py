"""Conversion of graphs that compute in other floating types to float32, which all stages start from."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.graph.files import save
from vlatool.graph.macs import COMPUTE
from vlatool.graph.nodes import rename_reads, subgraphs, unique_name, with_inner_nodes
from vlatool.graph.onnx_graph import FLOAT, OnnxGraph, type_name

FLOAT16, FLOAT64, BFLOAT16 = 10, 11, 16
"""``TensorProto.DataType``."""
ROUNDING = {"bfloat16": 0.05, "float16": 0.01}
"""Largest relative L2 difference between a graph in such a type, which rounds each value, and the same in float32."""
TYPE_ATTRIBUTES = ("to", "dtype", "stash_type", "output_dtype", "softmax_precision")
"""Attributes that hold a ``TensorProto.DataType``."""


def as_float32(model: Any) -> tuple[str, ...]:
    """Convert a graph whose layers compute in float16, bfloat16 or float64 to float32, in place.

    Weights in float16 and bfloat16 keep their values exactly, those in float64 are rounded. Inputs and outputs keep
    their types, except bfloat16, which numpy lacks: these become float32. float64 or float16 next to layers in float32,
    such as phases, stays.

    Args:
        model: An ``onnx.ModelProto`` with its weights and with inlined local functions.

    Returns:
        The replaced types (``bfloat16``); empty without a change.
    """
    codes = _compute_types(model) & {FLOAT16, FLOAT64} | ({BFLOAT16} if _uses_type(model.graph, BFLOAT16) else set())
    if not codes:
        return ()
    for value in (*model.graph.input, *model.graph.output):
        if value.type.tensor_type.elem_type == BFLOAT16:
            value.type.tensor_type.elem_type = FLOAT
    interface = {value.name: value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)}
    _retype(model.graph, codes, outermost=True)
    _cast_interface(model.graph, {name: code for name, code in interface.items() if code in codes})
    return tuple(sorted(map(type_name, codes)))


def rewrite_as_float32(path: Path) -> tuple[str, ...]:
    """Convert a file as ``as_float32`` does; return the replaced types."""
    onnx = require("onnx", "build")
    light = onnx.load(str(path), load_external_data=False)
    if not (_compute_types(light) & {FLOAT16, FLOAT64} or _uses_type(light.graph, BFLOAT16)):
        return ()
    model = onnx.load(str(path))
    replaced = as_float32(model)
    save(model, path)
    return replaced


def describe_conversion(replaced: Iterable[str]) -> str:
    """Describe the conversion of a graph to float32."""
    types = " and ".join(replaced)
    return f"layers compute in {types}; the graph is converted to float32, which all stages start from"


def _compute_types(model: Any) -> set[int]:
    """Return the types of both operands of compute layers."""
    graph = OnnxGraph(model)
    types = {name: tensor.data_type for name, tensor in graph.constants.items()}
    with contextlib.suppress(Exception):  # the seam: onnx infers nothing beside operators that it does not know
        types |= graph.types
    layers = [node for node in with_inner_nodes(model.graph.node) if node.op_type in COMPUTE]
    return {types.get(name, 0) for node in layers for name in node.input[:2]}


def _graphs(graph: Any) -> Iterator[Any]:
    """Yield a graph and its subgraphs."""
    yield graph
    for node in with_inner_nodes(graph.node):
        yield from subgraphs(node)


def _uses_type(graph: Any, code: int) -> bool:
    """Return whether a value, a constant or an attribute of a graph has the type."""
    for inner in _graphs(graph):
        values = (*inner.input, *inner.output, *inner.value_info)
        if any(tensor.data_type == code for tensor in inner.initializer):
            return True
        if any(value.type.tensor_type.elem_type == code for value in values):
            return True
    items = (item for node in with_inner_nodes(graph.node) for item in node.attribute)
    return any((item.name in TYPE_ATTRIBUTES and item.i == code) or item.t.data_type == code for item in items)


def _retype(graph: Any, codes: set[int], outermost: bool) -> None:
    for value in graph.value_info if outermost else (*graph.input, *graph.output, *graph.value_info):
        if value.type.tensor_type.elem_type in codes:
            value.type.tensor_type.elem_type = FLOAT
    for tensor in graph.initializer:
        _widen(tensor, codes)
    for node in graph.node:
        for item in node.attribute:
            if item.name in TYPE_ATTRIBUTES and item.i in codes:
                item.i = FLOAT
            for tensor in (*([item.t] if item.HasField("t") else []), *item.tensors):
                _widen(tensor, codes)
        for inner in subgraphs(node):
            _retype(inner, codes, outermost=False)


def _widen(tensor: Any, codes: set[int]) -> None:
    if tensor.data_type in codes:
        helper = require("onnx.numpy_helper", "build")
        with np.errstate(over="ignore"):
            tensor.CopyFrom(helper.from_array(helper.to_array(tensor).astype(np.float32), tensor.name))


def _cast_interface(graph: Any, interface: dict[str, int]) -> None:
    """Insert a Cast after inputs, and before outputs, that keep another type."""
    helper = require("onnx.helper", "build")
    taken = {tensor.name for tensor in graph.initializer} | {name for node in graph.node for name in node.output}
    before, after = [], []
    for name in _names_among(graph.input, interface):
        inner = unique_name(f"{name}_float32", 0, taken)
        rename_reads(graph, name, inner)
        before.append(helper.make_node("Cast", [name], [inner], f"{name}/Cast", to=FLOAT))
    for name in _names_among(graph.output, interface):
        inner = unique_name(f"{name}_float32", 0, taken)
        rename_reads(graph, name, inner)
        for node in graph.node:
            node.output[:] = [inner if given == name else given for given in node.output]
        after.append(helper.make_node("Cast", [inner], [name], f"{name}/Cast", to=interface[name]))
    nodes = [*before, *graph.node, *after]
    del graph.node[:]
    graph.node.extend(nodes)


def _names_among(values: Iterable[Any], interface: dict[str, int]) -> list[str]:
    return [value.name for value in values if value.name in interface]
