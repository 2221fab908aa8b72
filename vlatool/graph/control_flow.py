"""Inlined bodies of If, Loop and Scan, so that shapes are inferred in them, too."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.graph.nodes import subgraphs, unique_name
from vlatool.graph.onnx_graph import static_shape

CONTROL_OPS = ("If", "Loop", "Scan")
MIN_SCAN_OPSET = 9
"""First opset whose Scan has no sequence lengths, which would determine the iterations."""
MAX_STACKED = 4096
"""Largest number of iterations for which stacked outputs of a loop get a shape."""


@dataclass(frozen=True)
class Branches:
    """The bodies of an If, one of which runs."""

    bodies: tuple[tuple[Item, ...], ...]


@dataclass(frozen=True)
class LoopBody:
    """The body of a Loop or Scan.

    Args:
        body: Items of one iteration.
        count: Number of iterations, when it is a constant.
        along: Value and axis whose length is the number of iterations, instead of ``count``.
    """

    body: tuple[Item, ...]
    count: int | None = None
    along: tuple[str, int] | None = None


Item = Any
"""A ``NodeProto``, ``Branches`` or ``LoopBody``."""


def with_unique_names(model: Any) -> Any:
    """Return a model without local functions and with unique names for nodes of subgraphs, changed in place."""
    if model.functions:
        model = require("onnx.inliner", "build").inline_local_functions(model)
    taken = {node.name for node in model.graph.node}
    for node in model.graph.node:
        _name_inside(node, taken)
    return model


def _name_inside(node: Any, taken: set[str]) -> None:
    for graph in subgraphs(node):
        for number, inner in enumerate(graph.node):
            if not inner.name or inner.name in taken:
                base = inner.name or f"{node.name or node.op_type}/{inner.op_type}"
                inner.name = unique_name(base, number, taken)
            taken.add(inner.name)
            _name_inside(inner, taken)


def flatten(graph: Any, opset: int, known: Mapping[str, Any]) -> list[Item]:
    """Replace every control-flow node by one iteration of each of its bodies, in place.

    Values inside get unique names; a loop starts with its initial values.

    Args:
        graph: Graph of a model from ``with_unique_names``.
        known: Value -> ``ValueInfoProto`` from an earlier inference.

    Returns:
        The nodes of the graph, with bodies nested as they run.
    """
    flat = _Flattener(graph, opset, known)
    items = flat.add_nodes(graph.node, {}, "")
    del graph.node[:]
    graph.node.extend(flat.nodes)
    return list(items)


def all_nodes(items: list[Item]) -> Iterator[Any]:
    """Yield all nodes of the result of ``flatten``, including bodies, in order."""
    for item in items:
        if isinstance(item, Branches):
            for body in item.bodies:
                yield from all_nodes(list(body))
        elif isinstance(item, LoopBody):
            yield from all_nodes(list(item.body))
        else:
            yield item


@dataclass
class _Flattener:
    graph: Any
    opset: int
    known: Mapping[str, Any]
    nodes: list[Any] = field(default_factory=list)
    count: int = 0

    def add_nodes(self, nodes: Any, names: Mapping[str, str], prefix: str) -> tuple[Item, ...]:
        """Add nodes under new names; return them with nested bodies."""
        inside = {**names}
        items: list[Item] = []
        for node in nodes:
            renamed = _rename(node, inside, prefix)
            bodies = {item.name: item.g for item in node.attribute if item.HasField("g")}
            is_control = not node.domain and node.op_type in CONTROL_OPS and bodies
            if is_control and not (node.op_type == "Scan" and self.opset < MIN_SCAN_OPSET):
                items.append(self._body(renamed, bodies, inside))
            else:
                items.append(renamed)
                self.nodes.append(renamed)
        return tuple(items)

    def _body(self, node: Any, bodies: Mapping[str, Any], names: Mapping[str, str]) -> Branches | LoopBody:
        if node.op_type == "If":
            branches = [self._add_body(body, names, []) for body in bodies.values()]
            for name, given in zip(node.output, branches[0][1], strict=False):
                self._connect_output(name, given, None, 0)
            return Branches(tuple(items for items, _ in branches))
        flatten_loop = self._loop if node.op_type == "Loop" else self._scan
        return flatten_loop(node, bodies["body"], names)

    def _loop(self, node: Any, body: Any, names: Mapping[str, str]) -> LoopBody:
        states = list(node.input[2:])
        first = self._add_constant("turn", np.array(0, np.int64))
        holds = self._add_constant("condition", np.array(True))
        items, given = self._add_body(body, names, [first, holds, *states])
        count = self._constant(node.input[0]) if node.input[0] else None
        for index, (name, value) in enumerate(zip(node.output, given[1:], strict=False)):
            self._connect_output(name, value, None if index < len(states) else count or 0, 0)
        return LoopBody(items, count)

    def _scan(self, node: Any, body: Any, names: Mapping[str, str]) -> LoopBody:
        options = {item.name: item for item in node.attribute}
        count = int(options["num_scan_inputs"].i)
        states, scanned = list(node.input[:-count]), list(node.input[-count:])
        into, out = (
            list(options[name].ints) if name in options else [] for name in ("scan_input_axes", "scan_output_axes")
        )
        zero, slices = self._add_constant("first", np.array(0, np.int64)), []
        for index, name in enumerate(scanned):
            slices.append(self._name("slice"))
            self._add("Gather", [name, zero], slices[-1], axis=into[index] if into else 0)
        items, given = self._add_body(body, names, [*states, *slices])
        axis = into[0] if into else 0
        length = static_shape(self.known[scanned[0]].type.tensor_type) if scanned[0] in self.known else None
        for index, (name, value) in enumerate(zip(node.output, given, strict=False)):
            stacked = index - len(states)
            along = out[stacked] if out and stacked >= 0 else 0
            self._connect_output(name, value, None if stacked < 0 else (length[axis] if length else 0), along)
        return LoopBody(items, along=(scanned[0], axis))

    def _add_body(self, body: Any, names: Mapping[str, str], fed: list[str]) -> tuple[tuple[Item, ...], list[str]]:
        """Add the nodes of a body; return them, and the names of its outputs."""
        prefix = self._name("inside") + "/"
        inside = {**names, **dict(zip((value.name for value in body.input), fed, strict=False))}
        for tensor in body.initializer:
            self.graph.initializer.append(tensor)
            self.graph.initializer[-1].name = inside[tensor.name] = prefix + tensor.name
        for name in (name for node in body.node for name in node.output if name):
            inside[name] = prefix + name
        items = self.add_nodes(body.node, inside, prefix)
        return items, [inside.get(value.name, value.name) for value in body.output]

    def _connect_output(self, name: str, value: str, stacked: int | None, axis: int) -> None:
        """Connect a value of a body to an output of its node: directly, or stacked over the iterations."""
        if not name:
            return
        before = self.known.get(name)
        if before is not None and static_shape(before.type.tensor_type) is not None:
            self.graph.value_info.append(before)
        elif stacked is None:
            self._add("Identity", [value], name)
        elif 0 < stacked <= MAX_STACKED:
            part = self._name("part")
            if self.opset < 13:
                self._add("Unsqueeze", [value], part, axes=[axis])
            else:
                self._add("Unsqueeze", [value, self._add_constant("axes", np.array([axis], np.int64))], part)
            self._add("Concat", [part] * stacked, name, axis=axis)

    def _add(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> None:
        self.nodes.append(require("onnx.helper", "build").make_node(kind, inputs, [output], output, **attributes))

    def _add_constant(self, what: str, values: Any) -> str:
        name = self._name(what)
        self.graph.initializer.append(require("onnx.numpy_helper", "build").from_array(values, name))
        return name

    def _name(self, what: str) -> str:
        self.count += 1
        return f"vlatool.{what}.{self.count}"

    def _constant(self, name: str) -> int | None:
        """Return the number in a constant; None for other values."""
        helper = require("onnx.numpy_helper", "build")
        tensor = next((tensor for tensor in self.graph.initializer if tensor.name == name), None)
        maker = next((node for node in self.nodes if name in node.output), None)
        if tensor is None and maker is not None and maker.op_type == "Constant":
            tensor = next((item.t for item in maker.attribute if item.name == "value"), None)
        return None if tensor is None else int(np.asarray(helper.to_array(tensor)).reshape(-1)[0])


def _rename(node: Any, names: Mapping[str, str], prefix: str) -> Any:
    """Return a copy of a node with the names of the flat graph."""
    renamed = copy.deepcopy(node)
    renamed.input[:] = [names.get(name, name) for name in node.input]
    renamed.output[:] = [names.get(name, name) if prefix else name for name in node.output]
    return renamed
