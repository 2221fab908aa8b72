"""Cut the computation of phases out of a graph, so that it stays in float32 when the rest is computed in bfloat16.

A phase is what Sin and Cos take: position or denoising time multiplied by frequencies. bfloat16 has 8 significant bits,
so that a phase of 300 radians is off by up to one radian and its sine is noise; no later layer can repair that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vlatool.errors import require
from vlatool.graph.nodes import read_names, reads

PERIODIC = ("Sin", "Cos")
HEAVY = ("MatMul", "Gemm", "Conv", "Einsum", "Attention")


@dataclass(frozen=True)
class Cut:
    """The float32 part of a graph.

    Args:
        model: An ``onnx.ModelProto`` that computes ``values`` from ``inputs``.
        inputs: Inputs of the whole graph that it reads.
        values: Values that the rest of the graph reads from it.
        kept: Inputs of the whole graph that the rest still reads.
    """

    model: Any
    inputs: tuple[str, ...]
    values: tuple[str, ...]
    kept: tuple[str, ...]


def cut_phases(model: Any) -> Cut | None:
    """Move what leads to Sin and Cos from a graph into one of its own, in place.

    Args:
        model: An ``onnx.ModelProto``; afterwards the values of the cut are inputs of it.

    Returns:
        The cut, or None when no phase depends on an input, or when one depends on a heavy layer (a phase that the
        network itself computes cannot be cut out cheaply).
    """
    onnx = require("onnx", "build")
    graph = model.graph
    nodes = list(graph.node)
    chosen = _leading(graph, nodes)
    early = [nodes[index] for index in sorted(chosen)]
    if not early or any(node.op_type in HEAVY for node in early):
        return None
    late = [node for index, node in enumerate(nodes) if index not in chosen]
    outputs = {value.name for value in graph.output}
    read = read_names(late)
    given = [name for node in early for name in node.output]
    values = [name for name in given if name in read]
    if not values or outputs.intersection(given):
        return None
    typed = onnx.shape_inference.infer_shapes(_small(onnx, model, early))
    types = {value.name: value for value in (*typed.graph.value_info, *typed.graph.input)}
    if any(name not in types for name in values):
        return None
    early_reads = read_names(early)
    used = tuple(value.name for value in graph.input if value.name in early_reads)
    part = _part(onnx, model, early, [types[name] for name in used], [types[name] for name in values])
    kept = _shorten(onnx, model, late, [types[name] for name in values])
    return Cut(part, used, tuple(values), kept)


def _leading(graph: Any, nodes: list[Any]) -> set[int]:
    """Return the places of the nodes that lead from an input to Sin or Cos, those included."""
    dependent = {value.name for value in graph.input}
    producers: dict[str, int] = {}
    chosen: set[int] = set()
    for index, node in enumerate(nodes):
        producers.update(dict.fromkeys(node.output, index))
        if not dependent.isdisjoint(reads(node)):
            dependent.update(node.output)
            if node.op_type in PERIODIC:
                chosen.add(index)
    pending = list(chosen)
    while pending:
        for name in reads(nodes[pending.pop()]):
            before = producers.get(name)
            if before is not None and before not in chosen:
                chosen.add(before)
                pending.append(before)
    return chosen


def _small(onnx: Any, model: Any, nodes: list[Any]) -> Any:
    """Return a model of those nodes alone, with every input and the constants that they read."""
    read = read_names(nodes)
    graph = onnx.helper.make_graph(
        nodes, "phases", [value for value in model.graph.input if value.name in read], [],
        [tensor for tensor in model.graph.initializer if tensor.name in read],
    )  # fmt: skip
    return onnx.helper.make_model(graph, opset_imports=list(model.opset_import), ir_version=model.ir_version)


def _part(onnx: Any, model: Any, nodes: list[Any], inputs: list[Any], outputs: list[Any]) -> Any:
    made = _small(onnx, model, nodes)
    del made.graph.input[:]
    made.graph.input.extend(inputs)
    made.graph.output.extend(outputs)
    return made


def _shorten(onnx: Any, model: Any, late: list[Any], values: list[Any]) -> tuple[str, ...]:
    """Keep the late nodes alone; return the inputs that they still read."""
    graph = model.graph
    read = read_names(late)
    nodes = [onnx.NodeProto.FromString(node.SerializeToString()) for node in late]
    inputs = [value for value in graph.input if value.name in read]
    constants = [tensor for tensor in graph.initializer if tensor.name in read]
    kept = tuple(value.name for value in inputs)
    inputs = [onnx.ValueInfoProto.FromString(value.SerializeToString()) for value in (*inputs, *values)]
    constants = list(constants)
    del graph.node[:]
    graph.node.extend(nodes)
    del graph.input[:]
    graph.input.extend(inputs)
    rest = [tensor.name for tensor in constants]
    for index in range(len(graph.initializer) - 1, -1, -1):
        if graph.initializer[index].name not in rest:
            del graph.initializer[index]
    return kept
