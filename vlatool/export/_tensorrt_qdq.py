"""Quantize and dequantize pairs as TensorRT takes them: int8 around 0, weights' scales on axis 0, float biases."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError
from vlatool.graph.onnx_graph import FLOAT, OnnxGraph

Array = NDArray[Any]
INT8, UINT8, INT32 = 3, 2, 6
"""``TensorProto.DataType``."""
LAYERS = ("MatMul", "Gemm")
MOVES = ("Transpose", "Reshape", "Slice", "Squeeze", "Unsqueeze", "Flatten", "Identity", "Split", "Expand", "Gather")
"""Operators that move the values of their first input and compute nothing."""
MAX_CODE = 127


class TensorrtQdq(OnnxGraph):
    """A graph with quantize/dequantize pairs that is rewritten in place.

    Args:
        model: an ``onnx.ModelProto`` with its weights.
        fix: remedy for pairs that cannot be written so.

    Attributes:
        requantized: activations whose uint8 codes became int8: their range is the same around 0, their step larger.
    """

    def __init__(self, model: Any, fix: str) -> None:
        super().__init__(model)
        self.fix = fix
        self.requantized: list[str] = []

    def write(self) -> None:
        """Rewrite biases, activations and weights.

        Raises:
            GraphError: where scales or zero points are computed, or codes are read by anything but DequantizeLinear.
        """
        for node in list(self.graph.node):
            if node.op_type == "QuantizeLinear":
                self._activation(node)
        for node in list(self.graph.node):
            if node.op_type == "DequantizeLinear" and node.input[0] in self.constants:
                self._constant(node)
        self.drop_unread_constants()
        del self.graph.value_info[:]

    def _activation(self, node: Any) -> None:
        """Write an activation as int8 around 0: with the scale that it has, or one for the range of its uint8 codes."""
        scale, zero, kind = self._scale(node), self._zero(node), self._kind(node)
        readers = self.readers[node.output[0]]
        if any(reader.op_type != "DequantizeLinear" for reader in readers):
            names = ", ".join(sorted({reader.op_type for reader in readers} - {"DequantizeLinear"}))
            raise self._refused(node, f"its codes are read by {names}")
        if kind == INT8 and not zero.any():
            return
        if any([*reader.input[1:]] != [*node.input[1:]] for reader in readers):
            raise self._refused(node, "its codes are read with other scales")
        lowest, highest = (0, 255) if kind == UINT8 else (-128, 127)
        if kind not in (INT8, UINT8) or scale.size != 1:
            raise self._refused(node, "it has several scales, or codes of another type than int8 and uint8")
        low, high = (float(scale.item()) * (code - int(zero.item())) for code in (lowest, highest))
        step = np.float32(max(-low, high) / MAX_CODE)
        ends = [self.add(f"{node.output[0]}.int8.scale", step), self.add(f"{node.output[0]}.int8.zero", np.int8(0))]
        for each in (node, *readers):
            del each.input[1:]
            each.input.extend(ends)
        self.requantized.append(node.input[0])

    def _constant(self, node: Any) -> None:
        """Write a stored bias as float32, and a weight as int8 with its scales on axis 0."""
        codes, scale, zero = self.array(node.input[0]), self._scale(node), self._zero(node)
        if self.constants[node.input[0]].data_type == INT32:
            axis = next((item.i for item in node.attribute if item.name == "axis"), 1)
            self._replace(node, _scaled(codes, scale, zero, axis))
        elif self.constants[node.input[0]].data_type == UINT8 and np.all(zero == 128):
            shifted = (codes.astype(np.int16) - 128).astype(np.int8)
            self._store(node, shifted, scale, next((item.i for item in node.attribute if item.name == "axis"), 1))
        elif self.constants[node.input[0]].data_type != INT8 or zero.any():
            raise self._refused(node, "its weights are not int8 around 0")
        if node.op_type == "DequantizeLinear" and scale.size > 1:
            self._turn(node)

    def _turn(self, node: Any) -> None:
        """Store the weights of a product with the axis of their scales first, and turn them back after."""
        codes, scale = self.array(node.input[0]), self._scale(node)
        axis = next((item.i for item in node.attribute if item.name == "axis"), 1) % codes.ndim
        readers = self.readers[node.output[0]]
        if axis == 0:
            return
        if codes.ndim != 2 or any(
            reader.op_type not in LAYERS or reader.input[1] != node.output[0] for reader in readers
        ):
            raise self._refused(node, f"its weights have their scales on axis {axis}")
        self._store(node, np.ascontiguousarray(codes.T), scale, 0)
        name = f"{node.output[0]}.turned"
        turned = self.onnx.helper.make_node("Transpose", [node.output[0]], [name], f"{node.name}/turn", perm=[1, 0])
        for reader in readers:
            reader.input[1] = name
        self.graph.node.insert(list(self.graph.node).index(node) + 1, turned)

    def _store(self, node: Any, codes: Array, scale: Array, axis: int) -> None:
        base = f"{node.output[0]}.axis{axis}"
        zero = np.zeros(scale.shape, np.int8)
        ends = [self.add(f"{base}.codes", codes), self.add(f"{base}.scale", scale), self.add(f"{base}.zero", zero)]
        del node.input[:]
        node.input.extend(ends)
        del node.attribute[:]
        if scale.size > 1:
            node.attribute.append(self.onnx.helper.make_attribute("axis", axis))

    def _replace(self, node: Any, values: Array) -> None:
        """Put a constant in the place of a node."""
        name = self.add(f"{node.output[0]}.float32", values)
        for reader in self.readers[node.output[0]]:
            reader.input[:] = [name if value == node.output[0] else value for value in reader.input]
        self.graph.node.remove(node)

    def _scale(self, node: Any) -> Array:
        return self._values(node, 1)

    def _zero(self, node: Any) -> Array:
        return self._values(node, 2) if len(node.input) > 2 and node.input[2] else np.zeros((), np.int64)

    def _kind(self, node: Any) -> int:
        return self.constants[node.input[2]].data_type if len(node.input) > 2 and node.input[2] else UINT8

    def _values(self, node: Any, index: int) -> Array:
        if node.input[index] not in self.constants:
            raise self._refused(node, "its scale or zero point is computed")
        return self.array(node.input[index])

    def _refused(self, node: Any, why: str) -> GraphError:
        return GraphError(f"TensorRT does not take the {node.op_type} '{node.name}': {why}.", self.fix)


def cast_pixels(model: Any) -> None:
    """Cast uint8 inputs to float32 before what only moves their values; the parser takes uint8 as an input alone."""
    graph = OnnxGraph(model)
    for value in graph.graph.input:
        if value.type.tensor_type.elem_type == UINT8 and _is_cast_in_the_end(graph, value.name):
            name = f"{value.name}.float32"
            graph.replace_reads(value.name, name)
            graph.graph.node.insert(0, graph.node("Cast", [value.name], [name], f"{value.name}/cast", to=FLOAT))
    del graph.graph.value_info[:]


def _is_cast_in_the_end(graph: OnnxGraph, name: str) -> bool:
    """Return whether a value goes through nothing but operators that move it before each is cast."""
    readers = graph.readers[name]
    return name not in graph.outputs and all(
        reader.op_type == "Cast"
        or (
            reader.op_type in MOVES
            and reader.input[0] == name
            and all(_is_cast_in_the_end(graph, one) for one in reader.output)
        )
        for reader in readers
    )


def _scaled(codes: Array, scale: Array, zero: Array, axis: int) -> Array:
    """Return the float32 values of stored codes."""
    if scale.size > 1 and codes.ndim:
        shape = [1] * codes.ndim
        shape[axis % codes.ndim] = -1
        scale, zero = scale.reshape(shape), zero.reshape(shape) if zero.size > 1 else zero
    return ((codes.astype(np.float64) - zero) * scale).astype(np.float32)
