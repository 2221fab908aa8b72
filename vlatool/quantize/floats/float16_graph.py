"""Convert a float32 graph to float16 with ONNX Runtime's converter, and repair its defects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.graph.nodes import read_names
from vlatool.graph.onnx_graph import FLOAT, OnnxGraph
from vlatool.graph.phase import HEAVY, PERIODIC
from vlatool.runtime.engines import build_tool

FLOAT16_MAX = 65504.0
"""Largest finite float16."""
SMALLEST_NORMAL = 2.0**-14
"""Smallest normal float16; smaller values lose bits, and become zero on engines that flush subnormals."""
FLOAT16 = 10  # onnx.TensorProto.FLOAT16
NO_TYPE = 0  # onnx.TensorProto.UNDEFINED
INTEGERS = (2, 3, 4, 5, 6, 7, 12, 13)  # onnx.TensorProto: (u)int8, (u)int16, (u)int32, (u)int64


@dataclass(frozen=True)
class WeightLosses:
    """Damage that float16 does to constants.

    Args:
        overflowing: Nodes that read a constant with a finite magnitude beyond float16.
        subnormal: Entries of the constants of all other nodes that are below ``SMALLEST_NORMAL`` and not zero.
    """

    overflowing: tuple[str, ...]
    subnormal: int


def phase_nodes(model: Any) -> set[str]:
    """Return the names of the nodes whose precision decides a phase or an index.

    float16 has 11 significant bits: a phase of 300 radians is off by up to an eighth of a radian, and whole numbers
    above 2048 are rounded. The nodes are those that lead to Sin, Cos, or a Cast to an integer type, up to the heavy
    layers before them.
    """
    graph = OnnxGraph(model)
    pending = [node for node in model.graph.node if node.op_type in PERIODIC or _cast_to(node) in INTEGERS]
    names: set[str] = set()
    while pending:
        node = pending.pop()
        if node.name not in names:
            names.add(node.name)
            float_inputs = [name for name in node.input if graph.types.get(name, NO_TYPE) in (FLOAT, NO_TYPE)]
            producers = [graph.producers[name] for name in float_inputs if name in graph.producers]
            pending.extend(node for node in producers if node.op_type not in HEAVY)
    return names


def weight_losses(model: Any, kept: set[str]) -> WeightLosses:
    """Return the damage that float16 would do to the constants that nodes outside ``kept`` read."""
    graph = OnnxGraph(model)
    beyond: dict[str, None] = {}
    subnormal = 0
    for name in filter(graph.is_weight, graph.constants):
        readers = [node.name for node in graph.readers[name] if node.name not in kept and name in node.input]
        sizes = np.abs(graph.array(name)) if readers else np.zeros(0)
        if ((sizes > FLOAT16_MAX) & np.isfinite(sizes)).any():
            beyond.update(dict.fromkeys(readers))
        else:
            subnormal += int(((sizes < SMALLEST_NORMAL) & (sizes > 0)).sum())
    return WeightLosses(tuple(beyond), subnormal)


def nodes_touching(model: Any, values: Iterable[str]) -> set[str]:
    """Return the names of the nodes that produce or read one of the values."""
    names = set(values)
    return {node.name for node in model.graph.node if not names.isdisjoint((*node.input, *node.output))}


def to_float16(model: Any, kept: set[str]) -> Any:
    """Convert a graph, except the nodes named in ``kept``; inputs and outputs stay float32.

    ONNX Runtime's converter inserts a Cast to float16 and one back between two kept nodes, which rounds their values,
    repeats the same Cast for each reader, appends nodes at the end, and rounds a constant that a kept node shares with
    another one; all four are repaired here.
    """
    converter = build_tool("transformers.float16")
    _copy_shared_constants(model, kept)
    ends = {value.name for value in (*model.graph.input, *model.graph.output)}
    inferred = [value for value in OnnxGraph(model).value_infos if value.name not in ends]
    del model.graph.value_info[:]
    model.graph.value_info.extend(inferred)
    narrow = converter.convert_float_to_float16(
        model, keep_io_types=True, disable_shape_infer=True, node_block_list=sorted(kept)
    )
    graph = OnnxGraph(narrow)
    _drop_duplicate_nodes(graph)
    _bypass_casts(graph)
    names = {node.input[0]: node.output[0] for node in narrow.graph.node if _is_cast_to_float16(node)}
    _drop_unread_casts(graph)
    _restore_names(graph, names)
    graph.sort()
    del narrow.graph.value_info[:]
    return narrow


def _copy_shared_constants(model: Any, kept: set[str]) -> None:
    """Give kept nodes their own copies of the float32 constants that converted nodes read, too."""
    graph = OnnxGraph(model)
    shared = {
        name for node in model.graph.node if node.name not in kept for name in filter(graph.is_weight, node.input)
    }
    for node in (node for node in model.graph.node if node.name in kept):
        for index, name in enumerate(node.input):
            if name in shared:
                copy = f"{name}.float32"
                node.input[index] = copy if copy in graph.constants else graph.add_tensor(graph.constants[name], copy)


def _drop_duplicate_nodes(graph: OnnxGraph) -> None:
    given: set[str] = set()
    nodes = []
    for node in graph.graph.node:
        if node.output[0] not in given:
            nodes.append(node)
        given.update(node.output)
    graph.replace_nodes(nodes)


def _bypass_casts(graph: OnnxGraph) -> None:
    """Let kept nodes read the original float32 value instead of one that was cast to float16 and back."""
    sources = {node.output[0]: node.input[0] for node in graph.graph.node if _is_cast_to_float16(node)}
    inputs = {value.name for value in graph.graph.input}
    replacements: dict[str, str] = {}
    renamed: dict[str, str] = {}
    nodes = []
    for node in graph.graph.node:
        source = sources.get(node.input[0]) if _cast_to(node) == FLOAT else None
        is_output = node.output[0] in graph.outputs
        if source is None or (is_output and (source in inputs or source in renamed)):
            nodes.append(node)
        elif is_output:
            renamed[source] = node.output[0]
        else:
            replacements[node.output[0]] = source
    graph.replace_nodes(nodes)
    for node in graph.graph.node:
        node.input[:] = [renamed.get(name, name) for name in (replacements.get(name, name) for name in node.input)]
        node.output[:] = [renamed.get(name, name) for name in node.output]


def _is_cast_to_float16(node: Any) -> bool:
    own = node.name.endswith("_cast_to_fp16_node") or node.name.startswith("graph_input_cast")
    return bool(own and node.op_type == "Cast")


def _cast_to(node: Any) -> int:
    """Return the target type of a Cast; 0 for any other node."""
    return next((int(item.i) for item in node.attribute if item.name == "to" and node.op_type == "Cast"), NO_TYPE)


def _drop_unread_casts(graph: OnnxGraph) -> None:
    """Remove unused Casts and constants."""
    before = 0
    while before != (before := len(graph.graph.node)):
        read = read_names(graph.graph.node) | graph.outputs
        graph.replace_nodes(node for node in graph.graph.node if node.op_type != "Cast" or node.output[0] in read)
    graph.drop_unread_constants()


def _restore_names(graph: OnnxGraph, names: Mapping[str, str]) -> None:
    """Restore the names of values that stayed float32, which the converter gave to a Cast."""
    outputs = {name for node in graph.graph.node for name in node.output}
    fixed = graph.outputs.union(value.name for value in graph.graph.input)
    back = {name: old for name, old in names.items() if old not in outputs and name not in fixed}
    for node in graph.graph.node:
        node.input[:] = [back.get(name, name) for name in node.input]
        node.output[:] = [back.get(name, name) for name in node.output]
