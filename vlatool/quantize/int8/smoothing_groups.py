"""Find the activations of a graph whose channels can be scaled, and the constants that a scale can be folded into."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from vlatool.graph.layers import Layer
from vlatool.graph.onnx_graph import OnnxGraph

NORMS = ("LayerNormalization", "RMSNormalization")
HOMOGENEOUS = ("Relu", "LeakyRelu", "Identity", "Dropout")
"""``f(x / s) = f(x) / s`` for every positive s."""
RESHAPES = ("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Expand")
MOVES = (*RESHAPES, "Identity", "Dropout", "Transpose", "Slice", "Gather", "ReduceMean", "ReduceSum")
"""Operators that may leave the last axis as it is, and are linear."""
SUMS = ("Add", "Sub")
PRODUCTS = ("Mul", "Div")


@dataclass(frozen=True)
class Edit:
    """A constant that is multiplied along an axis by ``scale ** power``.

    Args:
        node: First output of the node that reads it.
        position: Which input of the node it is.
        axis: Axis of the constant that the channels lie on.
        start: Entry of the axis that is the first channel.
        power: -1 to divide by the scale.
        width: Entries of the axis, for a constant that is one number for all of them.
    """

    node: str
    position: int
    axis: int = -1
    start: int = 0
    power: int = -1
    width: int = 0


@dataclass(frozen=True)
class Group:
    """Layers that read the same channels and so share one scale.

    Args:
        value: The value that is divided by the scale.
        layers: Their weights are multiplied by it.
        edits: What divides ``value`` at no cost; empty when only an inserted Mul can.
    """

    value: str
    layers: tuple[Layer, ...]
    edits: tuple[Edit, ...] = ()

    @property
    def activations(self) -> tuple[str, ...]:
        """What the layers read: ``value``, or what operators that only move it make of it."""
        return tuple(dict.fromkeys(layer.activations[0] for layer in self.layers))


def find_groups(model: Any, layers: Iterable[Layer]) -> list[Group]:
    """Group layers by the channels that they read, in the order of the graph.

    Args:
        model: An ``onnx.ModelProto``.
        layers: MatMul and Gemm with constant weights, from ``find_layers`` of the same model.
    """
    topology = _Topology(model)
    flat = [layer for layer in layers if layer.weight and topology.is_weight(layer.weight, rank=2)]
    roots: dict[str, list[Layer]] = {}
    for layer in flat:
        roots.setdefault(topology.root(layer.activations[0]), []).append(layer)
    groups = []
    for value, members in roots.items():
        alone = topology.read_only_by(value, {layer.name for layer in members})
        edits = topology.edits(value) if alone else None
        if edits:
            groups.append(Group(value, tuple(members), tuple(edits)))
            continue
        names = dict.fromkeys(layer.activations[0] for layer in members)
        groups += [Group(name, tuple(layer for layer in members if layer.activations[0] == name)) for name in names]
    return groups


class _Topology(OnnxGraph):
    """Which nodes a scale can pass through."""

    def root(self, value: str) -> str:
        """Go up from a value as long as operators leave its last axis alone."""
        while (node := self.producers.get(value)) is not None and self._keeps_last(node):
            value = node.input[0]
        return value

    def read_only_by(self, value: str, layers: set[str]) -> bool:
        """Say whether every reader is one of the layers, operators that move the value passed through."""
        if value in self.outputs:
            return False
        for node in self.readers[value]:
            if node.name in layers and node.input[0] == value and list(node.input).count(value) == 1:
                continue
            if not self._keeps_last(node) or node.input[0] != value:
                return False
            if not all(self.read_only_by(name, layers) for name in node.output if name):
                return False
        return True

    def edits(self, value: str, start: int = 0) -> list[Edit] | None:
        """Return the constants that divide channels of a value, from ``start`` on, or None when nothing exact does."""
        node = self.producers.get(value)
        if node is None or not self.shapes.get(value):
            return None
        width = self.shapes[value][-1]
        if node.op_type in NORMS:
            return self._norm(node, value, start)
        if node.op_type in ("MatMul", "Gemm"):
            return self._product(node, start, width)
        if node.op_type in SUMS or node.op_type in PRODUCTS:
            return self._elementwise(node, start, width)
        if node.op_type == "Split":
            return self._split(node, value, start)
        if node.op_type in HOMOGENEOUS or self._keeps_last(node):
            return self._above(node.input[0], start)
        return None

    def _above(self, value: str, start: int) -> list[Edit] | None:
        """Go on with a value that only one node reads."""
        return self.edits(value, start) if len(self.readers[value]) == 1 and value not in self.outputs else None

    def _norm(self, node: Any, value: str, start: int) -> list[Edit] | None:
        axis, rank = self.attributes(node).get("axis", -1), len(self.shapes[value])
        fixed = all(self.is_weight(name) for name in node.input[1:] if name)
        if axis not in (-1, rank - 1) or node.output[0] != value or not fixed:
            return None
        return [Edit(node.output[0], place, start=start) for place, name in enumerate(node.input) if place and name]

    def _product(self, node: Any, start: int, width: int) -> list[Edit] | None:
        if not self.is_weight(node.input[1], rank=2):
            return None
        axis = 0 if self.attributes(node).get("transB") else 1
        edits = [Edit(node.output[0], 1, axis, start)]
        if node.op_type == "Gemm" and len(node.input) > 2 and node.input[2]:
            if not self.is_weight(node.input[2]):
                return None
            edits.append(Edit(node.output[0], 2, start=start, width=width))
        return edits

    def _elementwise(self, node: Any, start: int, width: int) -> list[Edit] | None:
        first, second = node.input[0], node.input[1]
        fixed = [place for place, name in enumerate(node.input) if self.is_weight(name)]
        if len(fixed) > 1 or (fixed == [0] and node.op_type == "Div"):
            return None
        adds = node.op_type in SUMS
        if not fixed:
            return self._two_activations(first, second, start, width, adds, node.op_type == "Div")
        place, other = fixed[0], node.input[1 - fixed[0]]
        if self.shapes.get(other, ())[-1:] != (width,):
            return None
        if adds:
            above = self._above(other, start)
            return None if above is None else [*above, Edit(node.output[0], place, start=start, width=width)]
        if self.shapes[node.input[place]][-1:] == (width,):
            return [Edit(node.output[0], place, start=start, power=1 if node.op_type == "Div" else -1)]
        return self._above(other, start)

    def _two_activations(
        self, first: str, second: str, start: int, width: int, adds: bool, divides: bool
    ) -> list[Edit] | None:
        wide = [name for name in (first, second) if self.shapes.get(name, ())[-1:] == (width,)]
        if adds:
            both = [self._above(name, start) for name in wide]
            return [edit for edits in both for edit in edits or []] if len(wide) == 2 and all(both) else None
        for name in wide:
            if name == second and divides:
                continue
            above = self._above(name, start)
            if above:
                return above
        return None

    def _split(self, node: Any, value: str, start: int) -> list[Edit] | None:
        """Go through a Split along the last axis: the channels are a range of the whole value's."""
        rank = len(self.shapes[value])
        if any(name not in self.shapes for name in node.output):
            return None
        if self.attributes(node).get("axis", 0) not in (-1, rank - 1):
            return None
        before = sum(self.shapes[name][-1] for name in list(node.output)[: list(node.output).index(value)])
        return self._above(node.input[0], start + before)

    def _keeps_last(self, node: Any) -> bool:
        """Say whether a node gives each entry of the last axis from the same entry of its first input, linearly."""
        if node.op_type not in MOVES or node.input[0] in self.constants:
            return False
        before, after = self.shapes.get(node.input[0]), self.shapes.get(node.output[0])
        if not before or not after or before[-1] != after[-1]:
            return False
        attributes, last = self.attributes(node), len(before) - 1
        if node.op_type == "Transpose":
            return bool(list(attributes.get("perm", range(last, -1, -1)))[-1] == last)
        if node.op_type == "Gather":
            return bool(attributes.get("axis", 0) not in (-1, last))
        if node.op_type in ("Slice", "ReduceMean", "ReduceSum"):
            axes = self._axes(node, attributes, 3 if node.op_type == "Slice" else 1)
            return axes is not None and last not in [axis % len(before) for axis in axes]
        return True

    def _axes(self, node: Any, attributes: dict[str, Any], place: int) -> list[int] | None:
        if "axes" in attributes:
            return list(attributes["axes"])
        name = node.input[place] if len(node.input) > place else ""
        return [int(axis) for axis in self.array(name).reshape(-1)] if name in self.constants else None
