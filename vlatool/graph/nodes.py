"""Names in a graph: inputs of nodes, and unique names for all nodes."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from vlatool.errors import require


def reads(node: Any) -> Iterator[str]:
    """Yield the values that a node reads, including those that its subgraphs (If, Loop, Scan) capture."""
    yield from (name for name in node.input if name)
    for graph in subgraphs(node):
        inside = {value.name for value in graph.input} | {tensor.name for tensor in graph.initializer}
        inside.update(name for inner in graph.node for name in inner.output)
        inside.discard("")
        yield from (name for inner in graph.node for name in reads(inner) if name not in inside)
        yield from (value.name for value in graph.output if value.name not in inside)


def subgraphs(node: Any) -> Iterator[Any]:
    """Yield the graphs that a node has as attributes (If, Loop, Scan)."""
    for item in node.attribute:
        yield from (*([item.g] if item.HasField("g") else []), *item.graphs)


def inner_nodes(node: Any) -> Iterator[Any]:
    """Yield the nodes of the subgraphs of a node, recursively."""
    for graph in subgraphs(node):
        yield from with_inner_nodes(graph.node)


def with_inner_nodes(nodes: Iterable[Any]) -> Iterator[Any]:
    """Yield nodes, each before those of its subgraphs."""
    for node in nodes:
        yield node
        yield from inner_nodes(node)


def read_names(nodes: Iterable[Any]) -> set[str]:
    """Return all values that nodes read."""
    return {name for node in nodes for name in reads(node)}


def rename_reads(graph: Any, old: str, new: str) -> None:
    """Rename a value wherever nodes of a graph, or of its subgraphs, read it."""
    for node in graph.node:
        node.input[:] = [new if name == old else name for name in node.input]
        for inner in subgraphs(node):
            rename_reads(inner, old, new)
            for value in inner.output:  # a value that a branch passes through
                value.name = new if value.name == old else value.name


def varying_values(model: Any) -> set[str]:
    """Return the values that depend on an input of a graph or on random numbers; all others are constant."""
    values = {value.name for value in model.graph.input} - {tensor.name for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type.startswith("Random") or not values.isdisjoint(reads(node)):
            values.update(name for name in node.output if name)
    return values


def name_nodes(model: Any) -> None:
    """Give every node of an ``onnx.ModelProto`` without a name, or with a repeated one, a unique name."""
    name_each(list(model.graph.node))


def name_each(nodes: Sequence[Any]) -> None:
    """Give the nodes of a graph, protobuf or ``onnx_ir``, unique names.

    Layers are selected and rewritten by the names of their nodes; some exporters leave them empty or repeat them.
    """
    taken = {node.name for node in nodes}
    seen = {"", None}
    for number, node in enumerate(nodes):
        if node.name in seen:
            node.name = unique_name(node.name or node.op_type, number, taken)
        seen.add(node.name)


def detach_constant_outputs(model: Any) -> None:
    """Insert an Identity between a constant and an output of the graph, in place, since methods change constants."""
    graph, outputs = model.graph, {value.name for value in model.graph.output}
    taken = {tensor.name for tensor in graph.initializer} | {name for node in graph.node for name in node.output}
    for tensor in (tensor for tensor in graph.initializer if tensor.name in outputs):
        name, copy = tensor.name, unique_name(tensor.name, 0, taken)
        for node in graph.node:
            node.input[:] = [copy if read == name else read for read in node.input]
        tensor.name = copy
        identity = require("onnx.helper", "build").make_node("Identity", [copy], [name], f"{copy}/Identity")
        graph.node.insert(0, identity)


def unique_name(base: str, number: int, taken: set[str]) -> str:
    """Return a new name for the node with that index, and add it to the taken ones."""
    name = f"{base}_{number}"
    while name in taken:
        name += "_"
    taken.add(name)
    return name


FOLDED_MODULE_KEY = "vlatool.folded"
"""Key of a node's metadata for the module that was folded into it."""


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    """Return whether a glob matches a node's name (``blocks.0.mlp.fc1/MatMul``) or its module's (before the slash)."""
    part = name.rpartition("/")[0] or name
    return any(fnmatch.fnmatchcase(name, pattern) or fnmatch.fnmatchcase(part, pattern) for pattern in patterns)
