"""Loop-invariant code motion: what a repeated graph computes alike in each repeat is cut out, to be computed once.

Keys and values of a prefix, to which each step of a denoising loop attends, are the usual case.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

from vlatool.bundle.program import ProgramStep
from vlatool.errors import require
from vlatool.graph.graph_cut import GraphCut, names_of

PRODUCTS = ("MatMul", "Gemm", "Conv")
MACS_PER_ELEMENT = 8
"""Fewest multiply-accumulates that are saved for each element that goes from one graph to the other."""


def changing_feeds(program: Sequence[ProgramStep], name: str) -> set[str] | None:
    """Return the inputs of a graph that differ between repeats: carried, scheduled, or given by the graph itself.

    Returns:
        None when the graph is not repeated.
    """
    steps = [step for step in program if step.graph == name]
    if all(step.repeat == 1 for step in steps):
        return None
    changed = [{*step.schedule, *step.carry.values(), *step.gives.values()} for step in steps]
    pairs = zip(steps, changed, strict=True)
    return {feed for step, values in pairs for feed, value in step.feeds.items() if value in values}


def name_of_once(program: Sequence[ProgramStep], name: str) -> str:
    """Return a name for the graph that runs before each loop over another one."""
    once = f"{name}_once"
    while once in {step.graph for step in program}:
        once += "_"
    return once


def compute_once(program: Iterable[ProgramStep], name: str, once: str, cut: GraphCut) -> tuple[ProgramStep, ...]:
    """Return the program in which the graph ``once`` runs before each loop over the graph ``name``.

    Of a policy of two systems, what follows from the values of the slow part alone is computed with them, once for each
    of its runs.
    """
    program = tuple(program)
    slow = next((step.slow for step in program if step.slow), {})
    given = [{value for step in program if bool(step.slow) == part for value in step.gives.values()}
             for part in (True, False)]  # fmt: skip
    steps: list[ProgramStep] = []
    for step in program:
        if step.graph != name:
            steps.append(step)
            continue
        values = {value: f"{once}.{value}" for value in cut.values}
        first = ProgramStep(once, {feed: step.feeds[feed] for feed in cut.inputs}, values, slow=step.slow)
        rest = replace(step, feeds={**{feed: step.feeds[feed] for feed in cut.kept}, **values})
        if not step.sources().isdisjoint(first.feeds.values()):
            first = replace(first, noise=step.noise, keep=step.keep)
            rest = replace(rest, noise={}, keep={})
        elif first.feeds and not step.slow and {*first.feeds.values()} <= given[0] - given[1]:
            first = replace(first, slow=slow)
        steps += [first, rest]
    return tuple(sorted(steps, key=lambda step: slow != {} and not step.slow))


def cut_loop_invariants(model: Any, changing: Collection[str]) -> GraphCut | None:
    """Move the nodes that depend on no changing input into another graph, in place.

    They are products, what leads to them, and what follows without becoming larger (biases, transpositions).

    Args:
        model: An ``onnx_ir.Model``; afterwards the values of the cut are its inputs.
        changing: Names of the inputs that differ between repeats.

    Returns:
        The cut, or None when there is no such product, or less is saved than it costs to pass the values on.
    """
    ir = require("onnx_ir", "build")
    graph = model.graph
    moved = _nodes_worth_moving(graph, changing)
    values = [value for node in graph if node in moved for value in node.outputs if _read_outside(value, moved)]
    carried = sum(map(_size, values))
    if not moved or not sum(map(_macs, moved)) >= MACS_PER_ELEMENT * carried:
        return None
    fixed = [value for value in graph.inputs if value.name not in changing]
    inputs = [value for value in fixed if any(use.node in moved for use in value.uses())]
    part = ir.convenience.extract(graph, inputs, values)
    _sort_initializers(part)
    once = ir.Model(part, ir_version=model.ir_version, functions=[each.clone() for each in model.functions.values()])
    _replace_by_inputs(model, values, moved)
    for value in inputs:
        if not value.uses():
            graph.inputs.remove(value)
    kept = [value.name for value in graph.inputs[: len(graph.inputs) - len(values)]]
    return GraphCut(once, names_of(inputs), names_of(values), tuple(kept))


def _nodes_worth_moving(graph: Any, changing: Collection[str]) -> set[Any]:
    nodes, fixed = _fixed_nodes(graph, changing)
    moved = set[Any]()
    pending = [node for node in nodes if _macs(node) >= MACS_PER_ELEMENT * _sizes(node.outputs)]
    while pending:
        node = pending.pop()
        if node not in moved:
            moved.add(node)
            pending += [maker for value in node.inputs if value in fixed and (maker := value.producer()) is not None]
    for node in nodes:
        read = fixed.intersection(node.inputs)
        follows = all(value.producer() in moved for value in read)
        if follows and _sizes(node.outputs) <= _sizes(read):
            moved.add(node)
    return moved


def _fixed_nodes(graph: Any, changing: Collection[str]) -> tuple[list[Any], set[Any]]:
    """Return the nodes that depend on inputs, but on no changing one, and the values that do."""
    varying = {value for value in graph.inputs if value.name in changing}
    fixed = {value for value in graph.inputs if value not in varying and not value.is_initializer()}
    nodes = []
    for node in graph:
        closed = not any(each.type.name in ("GRAPH", "GRAPHS") for each in node.attributes.values())
        given = any(value.is_graph_output() for value in node.outputs)
        if not closed or given or not varying.isdisjoint(node.inputs):
            varying.update(node.outputs)
        elif not fixed.isdisjoint(node.inputs):
            fixed.update(node.outputs)
            nodes.append(node)
    return nodes, fixed


def _replace_by_inputs(model: Any, values: Iterable[Any], moved: set[Any]) -> None:
    """Read values from new inputs of the same names; remove the nodes that computed them, and what only those read."""
    ir, graph = require("onnx_ir", "build"), model.graph
    for value in values:
        new = ir.Value(name=value.name, shape=value.shape, type=value.type)
        ir.convenience.replace_all_uses_with(value, new)
        graph.inputs.append(new)
    graph.remove(moved, safe=True)
    require("onnx_ir.passes.common", "build").RemoveUnusedNodesPass()(model)


def _sort_initializers(graph: Any) -> None:
    """Give the weights one order, whatever the order of a set: equal exports have equal bytes."""
    ordered = sorted(graph.initializers.items())
    graph.initializers.clear()
    for _, value in ordered:
        graph.register_initializer(value)


def _read_outside(value: Any, nodes: Collection[Any]) -> bool:
    return any(use.node not in nodes for use in value.uses())


def _macs(node: Any) -> float:
    """Return the multiply-accumulates of a product of known shape, else 0."""
    if node.op_type not in PRODUCTS or node.domain not in ("", "ai.onnx") or _size(node.outputs[0]) == math.inf:
        return 0
    shape = node.inputs[1 if node.op_type == "Conv" else 0].shape
    axes = () if shape is None else tuple(shape)[1:] if node.op_type == "Conv" else tuple(shape)[-1:]
    if not axes or not all(isinstance(axis, int) for axis in axes):
        return 0
    return float(_size(node.outputs[0]) * math.prod(axes))


def _sizes(values: Iterable[Any]) -> float:
    return sum(map(_size, values))


def _size(value: Any) -> float:
    """Return the number of elements of a value; infinite when an axis is not known."""
    if value.shape is None or not all(isinstance(axis, int) for axis in value.shape):
        return math.inf
    return float(math.prod(value.shape))
