"""Products with weights as 1 x 1 convolutions over padded rows, which OpenVINO computes faster on matrix units (AMX).

A product of M rows is a convolution over an image of 1 x M pixels. Matrix units take rows in tiles of 16; OpenVINO's
convolution uses them better than its matrix product does, above all when the tiles are full. A row never looks at
another one in a product, in an elementwise operator or in the normalisation of rows, so that rows are added once and
stay until something mixes rows (attention); what they hold is never read.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vlatool.graph.nodes import read_names, reads
from vlatool.graph.onnx_graph import FLOAT
from vlatool.quantize.int8._value_forms import Forms, Names

FEWEST = 32
"""Rows from which a product is written as a convolution; fewer are a matter of memory, not of arithmetic."""
FUSED = frozenset({"Gelu", "Relu", "Sigmoid", "Tanh", "Mul", "QuantizeLinear", "DequantizeLinear"})
"""Operators that OpenVINO computes within the convolution that they follow, or over its pixels as they lie."""
BY_ROW = FUSED | {"Add", "Sub", "Div", "Pow", "Sqrt", "Reciprocal", "Neg", "Erf", "Clip", "Cast"}
"""Operators that compute each element by itself."""
SMALL = 1e-30
"""A bias that changes no sum. With a bias OpenVINO scales an int8 convolution's sums within it; without one (zeros are
removed) it does so after copying them as float32."""


def use_convolutions(model: Any) -> int:
    """Rewrite the products of a weight and at least ``FEWEST`` rows in place; return how many there were.

    A product keeps the name of its node, and takes the bias that is added next into itself. What depends on a symbolic
    shape stays as it is.

    Args:
        model: An ``onnx.ModelProto`` of opset 13 or later: float32, or with QDQ operators.
    """
    return _Rewriter(model).rewrite()


class _Rewriter(Forms):
    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.merged: set[str] = set()
        self.count = 0

    def rewrite(self) -> int:
        """Rebuild the list of nodes."""
        stored = set(self.constants)
        for node in self.graph.node:
            if node.output[0] in self.merged:
                continue
            if not (self._product(node) or self._in_pixels(node) or self._in_padded(node)):
                for name in reads(node):
                    self.rows(name)
                self.nodes.append(node)
        for value in self.graph.output:
            self.rows(value.name)
        if not self.count:
            del self.graph.initializer[len(stored) :]
            return 0
        read = read_names(self.nodes) | self.outputs
        self.replace_nodes(node for node in self.nodes if node.op_type != "DequantizeLinear" or node.output[0] in read)
        self.drop_unread_constants()
        used = {tensor.name for tensor in self.graph.initializer}
        inputs = [value for value in self.graph.input if value.name not in stored or value.name in used]
        del self.graph.value_info[:], self.graph.input[:]
        self.graph.input.extend(inputs)
        return self.count

    # ---- what is rewritten

    def _product(self, node: Any) -> bool:
        options = self.attributes(node)
        if node.op_type not in ("MatMul", "Gemm") or self.height(node.input[0]) < FEWEST:
            return False
        if options.get("transA", 0) or options.get("alpha", 1.0) != 1.0 or options.get("beta", 1.0) != 1.0:
            return False
        value, bias = node.output[0], node.input[2] if len(node.input) > 2 else ""
        channels = self.shapes.get(value, (0,))[-1]
        if bias and not self._is_vector(bias, channels):
            return False
        weight = self._weight(node.input[1], output_first=bool(options.get("transB", 0)))
        if not weight or not channels:
            return False
        if not bias:
            value, bias = self._with_bias(value, channels)
        if not bias and node.input[1] not in self.constants:
            bias = self.add(f"{value}/bias", np.full(channels, SMALL, np.float32))
        image = f"{value}/pixels"
        self.append("Conv", [self.pixels(node.input[0]), weight, *([bias] if bias else [])], image, node.name)
        self.forms[value] = Names("pixels", pixels=image)
        self.count += 1
        return True

    def _with_bias(self, value: str, channels: int) -> tuple[str, str]:
        """Return what a product gives with the bias that is added next, and that bias; empty when there is none."""
        readers = self.readers[value]
        if len(readers) == 1 and readers[0].op_type == "Add" and value not in self.outputs:
            others = [name for name in readers[0].input if name != value]
            if len(others) == 1 and self._is_vector(others[0], channels):
                self.merged.add(readers[0].output[0])
                return readers[0].output[0], others[0]
        return value, ""

    def _is_vector(self, name: str, channels: int) -> bool:
        return self.is_weight(name) and list(self.constants[name].dims) == [channels]

    def _weight(self, name: str, *, output_first: bool) -> str:
        """Return a weight (N, K, 1, 1) made of one (K, N), or (N, K); empty when the value is not a weight."""
        image = f"{name}/{'nk' if output_first else 'kn'}"
        if name in self.constants:
            return self._image_of(name, image, output_first) if self.is_weight(name, rank=2) else ""
        node = self.producers.get(name)
        if node is None or node.op_type != "DequantizeLinear" or any(part not in self.constants for part in node.input):
            return ""
        stored, scale = self.constants[node.input[0]], self.constants[node.input[1]]
        axis = self.attributes(node).get("axis", 1) % 2
        by_channel = len(scale.dims) == 1 and axis == (0 if output_first else 1)
        if len(stored.dims) != 2 or scale.data_type != FLOAT or not (by_channel or not scale.dims):
            return ""
        if image not in self.shapes:
            inputs = [self._image_of(node.input[0], f"{image}/stored", output_first), *node.input[1:]]
            self.append("DequantizeLinear", inputs, image, f"{node.name}/image", **({"axis": 0} if by_channel else {}))
            self.shapes[image] = ()
        return image

    def _image_of(self, name: str, image: str, output_first: bool) -> str:
        if image in self.constants:
            return image
        values = self.array(name)
        return self.add(image, (values if output_first else values.T)[:, :, None, None])

    def _in_pixels(self, node: Any) -> bool:
        """Write an elementwise operator after a convolution as one of pixels."""
        value, moving = node.output[0], [name for name in node.input if name and name not in self.constants]
        if node.op_type not in FUSED or not any(self.native(name) == "pixels" for name in moving):
            return False
        if self._mixed_next(node):
            return False
        if any(self.shapes.get(name, "?") != self.shapes.get(value) for name in moving):
            return False
        if any(name in self.constants and math.prod(self.constants[name].dims) != 1 for name in node.input):
            return False
        inputs = [self.pixels(name) if name in moving else self.number(name) for name in node.input]
        self.copy(node, inputs, f"{value}/pixels")
        self.forms[value] = Names("pixels", pixels=f"{value}/pixels")
        return True

    def _in_padded(self, node: Any) -> bool:
        """Let an operator that works on each row by itself work on more rows."""
        value, high = node.output[0], self.height(node.output[0])
        inputs = [name for name in node.input if name]
        if len(node.output) != 1 or not high or not any(self.native(name) in ("padded", "pixels") for name in inputs):
            return False
        if self._mixed_next(node):
            return False
        moving = [name for name in inputs if self.height(name) == high]
        leading = {self.shapes[name][:-1] for name in (*moving, value)}
        if len(leading) != 1 or not self._by_row(node, [name for name in inputs if name not in moving]):
            return False
        padded = self.padded_name(value)
        copy = self.copy(node, [self.padded(name) if name in moving else name for name in node.input], padded)
        self._last_axis(copy)
        self.forms[value] = Names("padded", rows=value if padded == value else "", padded=padded)
        return True

    def _mixed_next(self, node: Any) -> bool:
        """Say whether a quantization serves what mixes rows: then they are dropped before it, so that it stays near."""
        if node.op_type not in ("QuantizeLinear", "DequantizeLinear"):
            return False
        readers = self.readers[node.output[0]]
        if node.op_type == "QuantizeLinear":
            readers = [reader for dequantize in readers for reader in self.readers[dequantize.output[0]]]
        return not any(reader.op_type in ("MatMul", "Gemm", *BY_ROW) for reader in readers)

    def _by_row(self, node: Any, others: list[str]) -> bool:
        """Say whether an operator computes each row by itself; ``others`` are inputs that are the same for all rows."""
        last = (-1, len(self.shapes.get(node.input[0], ())) - 1)
        if node.op_type == "LayerNormalization":
            return self.attributes(node).get("axis", -1) in last and all(name in self.constants for name in others)
        if node.op_type == "ReduceMean":
            axes = self.attributes(node).get("axes", [])
            if len(node.input) > 1 and node.input[1] in self.constants:
                axes = self.array(node.input[1]).tolist()
            return len(axes) == 1 and axes[0] in last and self.attributes(node).get("keepdims", 1) == 1
        if node.op_type not in BY_ROW:
            return False
        shapes = [self.shapes.get(name, (0, 0)) for name in others]
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            return all(math.prod(shape) == 1 for shape in shapes)
        return all(len(shape) <= 3 and math.prod(shape[:-1]) == 1 for shape in shapes)

    def _last_axis(self, node: Any) -> None:
        """Name the last axis in a way that holds for any number of axes."""
        for item in node.attribute:
            if item.name == "axis":
                item.i = -1
            elif item.name == "axes":
                item.ints[:] = [-1]
        if node.op_type == "ReduceMean" and len(node.input) > 1:
            node.input[1] = self.numbers([-1])
