"""Turn a float32 graph into float16 with ONNX Runtime's converter, and repair what that leaves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.graph.nodes import read_names
from vlatool.graph.onnx_graph import FLOAT, OnnxGraph
from vlatool.graph.phase import HEAVY, PERIODIC
from vlatool.runtime.engines import build_tool

LARGEST = 65504.0
"""Largest finite float16."""
NORMAL = 2.0**-14
"""Smallest float16 with all its bits; what is smaller has fewer, and is zero on engines that flush."""
HALF = 10  # onnx.TensorProto.FLOAT16
UNKNOWN = 0  # onnx.TensorProto.UNDEFINED
INTEGERS = (2, 3, 4, 5, 6, 7, 12, 13)  # onnx.TensorProto: (u)int8, (u)int16, (u)int32, (u)int64


@dataclass(frozen=True)
class Weights:
    """What float16 does to constants.

    Args:
        beyond: Nodes that read a constant with a finite magnitude beyond float16.
        subnormal: Entries of the constants of all other nodes that are below ``NORMAL`` and not zero.
    """

    beyond: tuple[str, ...]
    subnormal: int


def phase_nodes(model: Any) -> set[str]:
    """Return the names of the nodes whose precision decides a phase or an index.

    float16 has 11 significant bits: a phase of 300 radians is off by up to an eighth of a radian, and whole numbers
    above 2048 are rounded. Chosen is what leads to Sin, Cos, and a Cast to an integer type, up to the heavy layers
    before it.
    """
    graph = OnnxGraph(model)
    pending = [node for node in model.graph.node if node.op_type in PERIODIC or _cast_to(node) in INTEGERS]
    names: set[str] = set()
    while pending:
        node = pending.pop()
        if node.name not in names:
            names.add(node.name)
            wide = [name for name in node.input if graph.types.get(name, UNKNOWN) in (FLOAT, UNKNOWN)]
            above = [graph.producers[name] for name in wide if name in graph.producers]
            pending.extend(node for node in above if node.op_type not in HEAVY)
    return names


def look_at_weights(model: Any, kept: set[str]) -> Weights:
    """Return what float16 would do to the constants that nodes outside ``kept`` read."""
    graph = OnnxGraph(model)
    beyond: dict[str, None] = {}
    subnormal = 0
    for name in filter(graph.is_weight, graph.constants):
        readers = [node.name for node in graph.readers[name] if node.name not in kept and name in node.input]
        sizes = np.abs(graph.array(name)) if readers else np.zeros(0)
        if ((sizes > LARGEST) & np.isfinite(sizes)).any():
            beyond.update(dict.fromkeys(readers))
        else:
            subnormal += int(((sizes < NORMAL) & (sizes > 0)).sum())
    return Weights(tuple(beyond), subnormal)


def around(model: Any, values: Iterable[str]) -> set[str]:
    """Return the names of the nodes that give or read one of the values."""
    names = set(values)
    return {node.name for node in model.graph.node if not names.isdisjoint((*node.input, *node.output))}


def to_float16(model: Any, kept: set[str]) -> Any:
    """Convert a graph, apart from the nodes named in ``kept``; inputs and outputs stay float32.

    ONNX Runtime's converter writes a Cast to float16 and one back between two nodes that are both kept, which rounds
    what shall not be rounded, gives the same Cast once for each reader, appends nodes at the end, and rounds a constant
    that a kept node shares with another; all four are repaired here.
    """
    converter = build_tool("transformers.float16")
    _part_shared_constants(model, kept)
    ends = {value.name for value in (*model.graph.input, *model.graph.output)}
    inferred = [value for value in OnnxGraph(model).inferred if value.name not in ends]
    del model.graph.value_info[:]
    model.graph.value_info.extend(inferred)
    narrow = converter.convert_float_to_float16(
        model, keep_io_types=True, disable_shape_infer=True, node_block_list=sorted(kept)
    )
    graph = OnnxGraph(narrow)
    _drop_repeated(graph)
    _bypass_casts(graph)
    names = {node.input[0]: node.output[0] for node in narrow.graph.node if _goes_down(node)}
    _drop_unread_casts(graph)
    _restore_names(graph, names)
    graph.sort()
    del narrow.graph.value_info[:]
    return narrow


def _part_shared_constants(model: Any, kept: set[str]) -> None:
    """Give kept nodes copies of the float32 constants that other nodes read too."""
    graph = OnnxGraph(model)
    shared = {
        name for node in model.graph.node if node.name not in kept for name in filter(graph.is_weight, node.input)
    }
    for node in (node for node in model.graph.node if node.name in kept):
        for place, name in enumerate(node.input):
            if name in shared:
                copy = f"{name}.float32"
                node.input[place] = copy if copy in graph.constants else graph.add_tensor(graph.constants[name], copy)


def _drop_repeated(graph: OnnxGraph) -> None:
    seen: set[str] = set()
    nodes = []
    for node in graph.graph.node:
        if node.output[0] not in seen:
            nodes.append(node)
        seen.update(node.output)
    graph.replace_nodes(nodes)


def _bypass_casts(graph: OnnxGraph) -> None:
    """Let kept nodes read what was float32 before the converter cast it down and up again."""
    down = {node.output[0]: node.input[0] for node in graph.graph.node if _goes_down(node)}
    inputs = {value.name for value in graph.graph.input}
    instead: dict[str, str] = {}
    renamed: dict[str, str] = {}
    nodes = []
    for node in graph.graph.node:
        wide = down.get(node.input[0]) if _cast_to(node) == FLOAT else None
        end = node.output[0] in graph.outputs
        if wide is None or (end and (wide in inputs or wide in renamed)):
            nodes.append(node)
        elif end:
            renamed[wide] = node.output[0]
        else:
            instead[node.output[0]] = wide
    graph.replace_nodes(nodes)
    for node in graph.graph.node:
        node.input[:] = [renamed.get(name, name) for name in (instead.get(name, name) for name in node.input)]
        node.output[:] = [renamed.get(name, name) for name in node.output]


def _goes_down(node: Any) -> bool:
    own = node.name.endswith("_cast_to_fp16_node") or node.name.startswith("graph_input_cast")
    return bool(own and node.op_type == "Cast")


def _cast_to(node: Any) -> int:
    """Return the type that a Cast gives; 0 for any other node."""
    return next((int(item.i) for item in node.attribute if item.name == "to" and node.op_type == "Cast"), UNKNOWN)


def _drop_unread_casts(graph: OnnxGraph) -> None:
    """Remove Casts and constants that nobody reads."""
    before = 0
    while before != (before := len(graph.graph.node)):
        read = read_names(graph.graph.node) | graph.outputs
        graph.replace_nodes(node for node in graph.graph.node if node.op_type != "Cast" or node.output[0] in read)
    graph.drop_unread_constants()


def _restore_names(graph: OnnxGraph, names: Mapping[str, str]) -> None:
    """Call values that are float32 throughout what they were called before the converter gave that name to a Cast."""
    outputs = {name for node in graph.graph.node for name in node.output}
    fixed = graph.outputs.union(value.name for value in graph.graph.input)
    back = {name: old for name, old in names.items() if old not in outputs and name not in fixed}
    for node in graph.graph.node:
        node.input[:] = [back.get(name, name) for name in node.input]
        node.output[:] = [back.get(name, name) for name in node.output]
