"""Names in a graph: what a node reads, and a name of its own for every node."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from vlatool.errors import require


def reads(node: Any) -> Iterator[str]:
    """Yield the values that a node reads, with those that the graphs inside it (If, Loop, Scan) take from outside."""
    yield from (name for name in node.input if name)
    for item in node.attribute:
        for graph in (item.g, *item.graphs) if item.HasField("g") or item.graphs else ():
            inside = {value.name for value in graph.input} | {tensor.name for tensor in graph.initializer}
            inside.update(name for inner in graph.node for name in inner.output)
            inside.discard("")
            yield from (name for inner in graph.node for name in reads(inner) if name not in inside)
            yield from (value.name for value in graph.output if value.name not in inside)


def nodes_inside(node: Any) -> Iterator[Any]:
    """Yield the nodes of the graphs inside of a node (If, Loop, Scan), and of those inside of them."""
    for item in node.attribute:
        for graph in (item.g, *item.graphs):
            for inner in graph.node:
                yield inner
                yield from nodes_inside(inner)


def read_names(nodes: Iterable[Any]) -> set[str]:
    """Return all values that nodes read."""
    return {name for node in nodes for name in reads(node)}


def rename_reads(graph: Any, old: str, new: str) -> None:
    """Rename a value wherever nodes of a graph, or of its subgraphs, read it."""
    for node in graph.node:
        node.input[:] = [new if name == old else name for name in node.input]
        for attribute in node.attribute:
            for inner in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
                rename_reads(inner, old, new)
                for value in inner.output:  # what a branch hands on as it is
                    value.name = new if value.name == old else value.name


def varying(model: Any) -> set[str]:
    """Return the values that depend on an input of a graph, or on chance; all others are computed once, or could be."""
    values = {value.name for value in model.graph.input} - {tensor.name for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type.startswith("Random") or not values.isdisjoint(reads(node)):
            values.update(name for name in node.output if name)
    return values


def name_nodes(model: Any) -> None:
    """Give every node of an ``onnx.ModelProto`` without a name, or with one that came before, a name of its own."""
    name_each(list(model.graph.node))


def name_each(nodes: Sequence[Any]) -> None:
    """Do so with the nodes of a graph, be they protobuf or ``onnx_ir``.

    Layers are chosen and rewritten by the names of their nodes; some exporters leave them empty or repeat them.
    """
    taken = {node.name for node in nodes}
    seen = {"", None}
    for number, node in enumerate(nodes):
        if node.name in seen:
            node.name = free_name(node.name or node.op_type, number, taken)
        seen.add(node.name)


def part_outputs(model: Any) -> None:
    """Put an Identity between a constant and an output of the graph that it is, in place: methods change constants."""
    graph, outputs = model.graph, {value.name for value in model.graph.output}
    taken = {tensor.name for tensor in graph.initializer} | {name for node in graph.node for name in node.output}
    for tensor in (tensor for tensor in graph.initializer if tensor.name in outputs):
        name, copy = tensor.name, free_name(tensor.name, 0, taken)
        for node in graph.node:
            node.input[:] = [copy if read == name else read for read in node.input]
        tensor.name = copy
        identity = require("onnx.helper", "build").make_node("Identity", [copy], [name], f"{copy}/Identity")
        graph.node.insert(0, identity)


def free_name(base: str, number: int, taken: set[str]) -> str:
    """Return a name for the node with that place in a graph which is none of those that are taken, and take it."""
    name = f"{base}_{number}"
    while name in taken:
        name += "_"
    taken.add(name)
    return name


FOLDED = "vlatool.folded"
"""Key of a node's metadata: the module that was folded into it."""


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    """Say whether a glob meets a node's name (``blocks.0.mlp.fc1/MatMul``), or its module's (before the slash)."""
    part = name.rpartition("/")[0] or name
    return any(fnmatch.fnmatchcase(name, pattern) or fnmatch.fnmatchcase(part, pattern) for pattern in patterns)
