"""Turn a float32 graph into float16 with ONNX Runtime's converter, and repair what that leaves."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.graph.nodes import read_names, reads
from vlatool.graph.phase import HEAVY, PERIODIC
from vlatool.graph.types import FLOAT, inferred_values
from vlatool.runtime.engines import build_tool

LARGEST = 65504.0
"""Largest finite float16."""
NORMAL = 2.0**-14
"""Smallest float16 with all its bits; what is smaller has fewer, and is zero on engines that flush."""
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
    onnx = require("onnx", "build")
    nodes = list(model.graph.node)
    producers = {name: node for node in nodes for name in node.output if name}
    pending = []
    for node in nodes:
        to = [item.i for item in node.attribute if item.name == "to"] if node.op_type == "Cast" else []
        if node.op_type in PERIODIC or (to and to[0] in INTEGERS):
            pending.append(node)
    types = {value.name: value.type.tensor_type.elem_type for value in inferred_values(model)}
    wide = (onnx.TensorProto.FLOAT, onnx.TensorProto.UNDEFINED)
    found: dict[str, None] = {}
    while pending:
        node = pending.pop()
        if node.name in found:
            continue
        found[node.name] = None
        above = [producers[name] for name in node.input if name in producers and types.get(name, 0) in wide]
        pending.extend(each for each in above if each.op_type not in HEAVY)
    return set(found)


def look_at_weights(model: Any, kept: set[str]) -> Weights:
    """Return what float16 would do to the constants that nodes outside ``kept`` read."""
    onnx = require("onnx", "build")
    readers: dict[str, list[str]] = {}
    for node in model.graph.node:
        for name in node.input:
            if node.name not in kept:
                readers.setdefault(name, []).append(node.name)
    beyond: list[str] = []
    subnormal = 0
    for tensor in model.graph.initializer:
        if tensor.data_type != FLOAT or tensor.name not in readers:
            continue
        sizes = np.abs(onnx.numpy_helper.to_array(tensor))
        if ((sizes > LARGEST) & np.isfinite(sizes)).any():
            beyond.extend(readers[tensor.name])
        else:
            subnormal += int(((sizes < NORMAL) & (sizes > 0)).sum())
    return Weights(tuple(dict.fromkeys(beyond)), subnormal)


def around(model: Any, values: Iterable[str]) -> set[str]:
    """Return the names of the nodes that give or read one of the values."""
    wanted = set(values)
    return {node.name for node in model.graph.node if not wanted.isdisjoint((*node.input, *node.output))}


def to_float16(model: Any, kept: set[str]) -> Any:
    """Convert a graph, apart from the nodes named in ``kept``; inputs and outputs stay float32.

    ONNX Runtime's converter writes a Cast to float16 and one back between two nodes that are both kept, which rounds
    what shall not be rounded, gives the same Cast once for each reader, appends nodes at the end, and rounds a constant
    that a kept node shares with another; all four are repaired here.
    """
    converter = build_tool("transformers.float16")
    _part_shared_constants(model, kept)
    ends = {value.name for value in (*model.graph.input, *model.graph.output)}
    del model.graph.value_info[:]
    model.graph.value_info.extend(value for value in inferred_values(model) if value.name not in ends)
    made = converter.convert_float_to_float16(
        model, keep_io_types=True, disable_shape_infer=True, node_block_list=sorted(kept)
    )
    _drop_repeated(made)
    _bypass_casts(made)
    names = {node.input[0]: node.output[0] for node in made.graph.node if _goes_down(node)}
    _drop_unused(made)
    _restore_names(made, names)
    _sort(made)
    del made.graph.value_info[:]
    return made


def _part_shared_constants(model: Any, kept: set[str]) -> None:
    """Give kept nodes copies of the float32 constants that other nodes read too."""
    onnx = require("onnx", "build")
    constants = {tensor.name: tensor for tensor in model.graph.initializer if tensor.data_type == FLOAT}
    converted = {name for node in model.graph.node if node.name not in kept for name in node.input}
    for node in model.graph.node:
        for place, name in enumerate(node.input):
            if node.name not in kept or name not in constants or name not in converted:
                continue
            copy = f"{name}.float32"
            if copy not in constants:
                tensor = onnx.TensorProto()
                tensor.CopyFrom(constants[name])
                tensor.name = copy
                model.graph.initializer.append(tensor)
                constants[copy] = tensor
            node.input[place] = copy


def _drop_repeated(model: Any) -> None:
    seen: set[str] = set()
    nodes = []
    for node in model.graph.node:
        if node.output[0] not in seen:
            nodes.append(node)
        seen.update(node.output)
    _replace(model, nodes)


def _bypass_casts(model: Any) -> None:
    """Let kept nodes read what was float32 before the converter cast it down and up again."""
    down = {node.output[0]: node.input[0] for node in model.graph.node if _goes_down(node)}
    outputs = {value.name for value in model.graph.output}
    inputs = {value.name for value in model.graph.input}
    instead: dict[str, str] = {}
    renamed: dict[str, str] = {}
    nodes = []
    for node in model.graph.node:
        wide = down.get(node.input[0]) if node.op_type == "Cast" and _to(node) == FLOAT else None
        end = node.output[0] in outputs
        if wide is None or (end and (wide in inputs or wide in renamed)):
            nodes.append(node)
        elif end:
            renamed[wide] = node.output[0]
        else:
            instead[node.output[0]] = wide
    for node in nodes:
        for place, name in enumerate(node.input):
            name = instead.get(name, name)
            node.input[place] = renamed.get(name, name)
        for place, name in enumerate(node.output):
            node.output[place] = renamed.get(name, name)
    _replace(model, nodes)


def _goes_down(node: Any) -> bool:
    own = node.name.endswith("_cast_to_fp16_node") or node.name.startswith("graph_input_cast")
    return bool(own and node.op_type == "Cast")


def _to(node: Any) -> int:
    return next((int(item.i) for item in node.attribute if item.name == "to"), 0)


def _drop_unused(model: Any) -> None:
    """Remove Casts and constants that nobody reads."""
    outputs = {value.name for value in model.graph.output}
    while True:
        read = read_names(model.graph.node) | outputs
        nodes = [node for node in model.graph.node if node.op_type != "Cast" or node.output[0] in read]
        if len(nodes) == len(model.graph.node):
            break
        _replace(model, nodes)
    for index in range(len(model.graph.initializer) - 1, -1, -1):
        if model.graph.initializer[index].name not in read:
            del model.graph.initializer[index]


def _restore_names(model: Any, names: Mapping[str, str]) -> None:
    """Call values that are float32 throughout what they were called before the converter gave that name to a Cast."""
    given = {name for node in model.graph.node for name in node.output}
    fixed = {value.name for value in (*model.graph.input, *model.graph.output)}
    back = {name: old for name, old in names.items() if old not in given and name not in fixed}
    for node in model.graph.node:
        for values in (node.input, node.output):
            for place, name in enumerate(values):
                values[place] = back.get(name, name)


def _sort(model: Any) -> None:
    """Put every node after what it reads, else in the order in which they are."""
    nodes = list(model.graph.node)
    producers = {name: index for index, node in enumerate(nodes) for name in node.output if name}
    waits = [{producers[name] for name in reads(node) if name in producers} for node in nodes]
    readers: dict[int, list[int]] = {}
    for index, before in enumerate(waits):
        for each in before:
            readers.setdefault(each, []).append(index)
    ready = [index for index, before in enumerate(waits) if not before]
    heapq.heapify(ready)
    order = []
    while ready:
        index = heapq.heappop(ready)
        order.append(nodes[index])
        for reader in readers.get(index, []):
            waits[reader].discard(index)
            if not waits[reader]:
                heapq.heappush(ready, reader)
    _replace(model, order)


def _replace(model: Any, nodes: list[Any]) -> None:
    kept = [type(node).FromString(node.SerializeToString()) for node in nodes]
    del model.graph.node[:]
    model.graph.node.extend(kept)
