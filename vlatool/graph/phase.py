"""Cut the computation of phases out of a graph, so that it stays in float32 when the rest is computed in bfloat16.

A phase is an argument of Sin and Cos: position or denoising time multiplied by frequencies. bfloat16 has 8 significant
bits, so a phase of 300 radians is off by up to one radian and its sine is noise; no later layer can repair that.
"""

from __future__ import annotations

from typing import Any

from vlatool.graph.graph_cut import GraphCut, names_of
from vlatool.graph.nodes import read_names, reads, varying_values
from vlatool.graph.onnx_graph import OnnxGraph

PERIODIC = ("Sin", "Cos")
HEAVY = ("MatMul", "Gemm", "Conv", "Einsum", "Attention")


def cut_phases(model: Any) -> GraphCut | None:
    """Move the nodes that lead to Sin and Cos into a separate graph, in place.

    Args:
        model: An ``onnx.ModelProto``; afterwards the values of the cut are its inputs.

    Returns:
        The cut, or None when no phase depends on an input, or when one depends on a heavy layer (a phase that the
        network itself computes cannot be cut out cheaply).
    """
    graph = OnnxGraph(model)
    names = _phase_nodes(graph)
    phase_nodes = [node for node in model.graph.node if node.output[0] in names]
    other_nodes = [node for node in model.graph.node if node.output[0] not in names]
    phase_values, read = [name for node in phase_nodes for name in node.output], read_names(other_nodes)
    values = [name for name in phase_values if name in read]
    heavy = any(node.op_type in HEAVY for node in phase_nodes)
    if heavy or not values or graph.outputs.intersection(phase_values):
        return None
    part = _model_of(phase_nodes, graph)
    typed = graph.onnx.shape_inference.infer_shapes(part).graph
    types = {value.name: value for value in typed.value_info}
    if any(name not in types for name in values):
        return None
    part.graph.output.extend(types[name] for name in values)
    graph.replace_nodes(other_nodes)
    graph.drop_unread_constants()
    inputs = [value for value in model.graph.input if value.name in read]
    del model.graph.input[:]
    model.graph.input.extend([*inputs, *(types[name] for name in values)])
    return GraphCut(part, names_of(part.graph.input), tuple(values), names_of(inputs))


def periodic_nodes(model: Any) -> list[Any]:
    """Return the Sin and Cos nodes whose argument depends on an input of the graph."""
    live = varying_values(model)
    return [node for node in model.graph.node if node.op_type in PERIODIC and not live.isdisjoint(node.input)]


def _phase_nodes(graph: OnnxGraph) -> set[str]:
    """Return the first output of each node that leads from an input to Sin or Cos, those included."""
    pending = periodic_nodes(graph.model)
    names: set[str] = set()
    while pending:
        node = pending.pop()
        if node.output[0] not in names:
            names.add(node.output[0])
            pending.extend(graph.producers[name] for name in reads(node) if name in graph.producers)
    return names


def _model_of(nodes: list[Any], graph: OnnxGraph) -> Any:
    """Return a model of the given nodes, with the inputs and constants that they read."""
    helper, read = graph.onnx.helper, read_names(nodes)
    inputs = [value for value in graph.graph.input if value.name in read]
    constants = [tensor for name, tensor in graph.constants.items() if name in read]
    part = helper.make_graph(nodes, "phases", inputs, [], constants)
    return helper.make_model(part, opset_imports=graph.model.opset_import, ir_version=graph.model.ir_version)
