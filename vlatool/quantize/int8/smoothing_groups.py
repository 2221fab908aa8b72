"""Find the activations of a graph whose channels can be scaled, and the constants that can absorb the scale."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from vlatool.graph.layers import Layer
from vlatool.graph.onnx_graph import OnnxGraph

NORM_OPS = ("LayerNormalization", "RMSNormalization")
HOMOGENEOUS_OPS = ("Relu", "LeakyRelu", "Identity", "Dropout")
"""``f(x / s) = f(x) / s`` for every positive s."""
RESHAPE_OPS = ("Reshape", "Flatten", "Squeeze", "Unsqueeze", "Expand")
MOVE_OPS = (*RESHAPE_OPS, "Identity", "Dropout", "Transpose", "Slice", "Gather", "ReduceMean", "ReduceSum")
"""Linear operators that may leave the last axis unchanged."""
SUM_OPS = ("Add", "Sub")
PRODUCT_OPS = ("Mul", "Div")


@dataclass(frozen=True)
class ConstantEdit:
    """A constant that is multiplied along an axis by ``scale ** power``.

    Args:
        node: First output of the node that reads it.
        position: Index of the constant among the inputs of the node.
        start: Index of the first channel on the axis.
        power: -1 to divide by the scale.
        width: Channels, for a constant that is one number for all of them.
    """

    node: str
    position: int
    axis: int = -1
    start: int = 0
    power: int = -1
    width: int = 0


@dataclass(frozen=True)
class SmoothingGroup:
    """Layers that read the same channels and therefore share one scale.

    Args:
        value: Value that is divided by the scale.
        layers: Layers whose weights are multiplied by it.
        edits: Edits that divide ``value`` at no cost; empty when only an inserted Mul can.
    """

    value: str
    layers: tuple[Layer, ...]
    edits: tuple[ConstantEdit, ...] = ()

    @property
    def activations(self) -> tuple[str, ...]:
        """Inputs of the layers: ``value``, or the outputs of operators that only move it."""
        return tuple(dict.fromkeys(layer.activations[0] for layer in self.layers))


def find_groups(model: Any, layers: Iterable[Layer]) -> list[SmoothingGroup]:
    """Group layers by their input channels, in the order of the graph.

    Args:
        model: An ``onnx.ModelProto``.
        layers: MatMul and Gemm with constant weights, from ``find_layers`` of the same model.
    """
    topology = _Topology(model)
    flat = [layer for layer in layers if layer.weight and topology.is_weight(layer.weight, rank=2)]
    roots: dict[str, list[Layer]] = {}
    for layer in flat:
        roots.setdefault(topology.last_axis_source(layer.activations[0]), []).append(layer)
    groups = []
    for value, members in roots.items():
        alone = topology.read_only_by(value, {layer.name for layer in members})
        edits = topology.edits(value) if alone else None
        if edits:
            groups.append(SmoothingGroup(value, tuple(members), tuple(edits)))
            continue
        names = dict.fromkeys(layer.activations[0] for layer in members)
        readers = ([layer for layer in members if layer.activations[0] == name] for name in names)
        groups += [SmoothingGroup(name, tuple(layers)) for name, layers in zip(names, readers, strict=True)]
    return groups


class _Topology(OnnxGraph):
    """A graph and the nodes that a scale can pass through."""

    def last_axis_source(self, value: str) -> str:
        """Return the value that a value comes from through operators that leave its last axis unchanged."""
        while (node := self.producers.get(value)) is not None and self._keeps_last_axis(node):
            value = node.input[0]
        return value

    def read_only_by(self, value: str, layers: set[str]) -> bool:
        """Return whether only the layers read a value, directly or through operators that move it."""
        if value in self.outputs:
            return False
        for node in self.readers[value]:
            if node.name in layers and node.input[0] == value and list(node.input).count(value) == 1:
                continue
            if not self._keeps_last_axis(node) or node.input[0] != value:
                return False
            if not all(self.read_only_by(name, layers) for name in node.output if name):
                return False
        return True

    def edits(self, value: str, start: int = 0) -> list[ConstantEdit] | None:
        """Return edits that divide channels of a value exactly, from ``start`` on; None when there are none."""
        node = self.producers.get(value)
        if node is None or not self.shapes.get(value):
            return None
        width = self.shapes[value][-1]
        if node.op_type in NORM_OPS:
            return self._norm(node, value, start)
        if node.op_type in ("MatMul", "Gemm"):
            return self._product(node, start, width)
        if node.op_type in SUM_OPS or node.op_type in PRODUCT_OPS:
            return self._elementwise(node, start, width)
        if node.op_type == "Split":
            return self._split(node, value, start)
        if node.op_type in HOMOGENEOUS_OPS or self._keeps_last_axis(node):
            return self._edits_above(node.input[0], start)
        return None

    def _edits_above(self, value: str, start: int) -> list[ConstantEdit] | None:
        """Return the edits of a value that only one node reads."""
        return self.edits(value, start) if len(self.readers[value]) == 1 and value not in self.outputs else None

    def _norm(self, node: Any, value: str, start: int) -> list[ConstantEdit] | None:
        axis, rank = self.attributes(node).get("axis", -1), len(self.shapes[value])
        fixed = all(self.is_weight(name) for name in node.input[1:] if name)
        if axis not in (-1, rank - 1) or node.output[0] != value or not fixed:
            return None
        constants = [index for index, name in enumerate(node.input) if index and name]
        return [ConstantEdit(node.output[0], index, start=start) for index in constants]

    def _product(self, node: Any, start: int, width: int) -> list[ConstantEdit] | None:
        if not self.is_weight(node.input[1], rank=2):
            return None
        axis = 0 if self.attributes(node).get("transB") else 1
        edits = [ConstantEdit(node.output[0], 1, axis, start)]
        if node.op_type == "Gemm" and len(node.input) > 2 and node.input[2]:
            if not self.is_weight(node.input[2]):
                return None
            edits.append(ConstantEdit(node.output[0], 2, start=start, width=width))
        return edits

    def _elementwise(self, node: Any, start: int, width: int) -> list[ConstantEdit] | None:
        first, second = node.input[0], node.input[1]
        fixed = [index for index, name in enumerate(node.input) if self.is_weight(name)]
        if len(fixed) > 1 or (fixed == [0] and node.op_type == "Div"):
            return None
        adds = node.op_type in SUM_OPS
        if not fixed:
            return self._two_activations(first, second, start, width, adds, node.op_type == "Div")
        index, other = fixed[0], node.input[1 - fixed[0]]
        if self.shapes.get(other, ())[-1:] != (width,):
            return None
        if adds:
            above = self._edits_above(other, start)
            return None if above is None else [*above, ConstantEdit(node.output[0], index, start=start, width=width)]
        if self.shapes[node.input[index]][-1:] == (width,):
            return [ConstantEdit(node.output[0], index, start=start, power=1 if node.op_type == "Div" else -1)]
        return self._edits_above(other, start)

    def _two_activations(
        self, first: str, second: str, start: int, width: int, adds: bool, divides: bool
    ) -> list[ConstantEdit] | None:
        wide = [name for name in (first, second) if self.shapes.get(name, ())[-1:] == (width,)]
        if adds:
            both = [self._edits_above(name, start) for name in wide]
            return [edit for edits in both for edit in edits or []] if len(wide) == 2 and all(both) else None
        for name in wide:
            if name == second and divides:
                continue
            above = self._edits_above(name, start)
            if above:
                return above
        return None

    def _split(self, node: Any, value: str, start: int) -> list[ConstantEdit] | None:
        """Return the edits before a Split along the last axis: the channels are a range of those of its input."""
        rank = len(self.shapes[value])
        if any(name not in self.shapes for name in node.output):
            return None
        if self.attributes(node).get("axis", 0) not in (-1, rank - 1):
            return None
        before = sum(self.shapes[name][-1] for name in list(node.output)[: list(node.output).index(value)])
        return self._edits_above(node.input[0], start + before)

    def _keeps_last_axis(self, node: Any) -> bool:
        """Return whether each entry of the last axis is linear in the same entry of the first input alone."""
        if node.op_type not in MOVE_OPS or node.input[0] in self.constants:
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

    def _axes(self, node: Any, attributes: dict[str, Any], index: int) -> list[int] | None:
        if "axes" in attributes:
            return list(attributes["axes"])
        name = node.input[index] if len(node.input) > index else ""
        return [int(axis) for axis in self.array(name).reshape(-1)] if name in self.constants else None
