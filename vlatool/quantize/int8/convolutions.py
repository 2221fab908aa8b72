"""Products with weights as 1 x 1 convolutions over padded rows, which OpenVINO computes faster on matrix units (AMX).

A product of M rows is a convolution over an image of 1 x M pixels. Matrix units take rows in tiles of 16; OpenVINO's
convolution uses them better than its matrix product does, above all when the tiles are full. Rows are independent in a
product, in an elementwise operator and in a normalisation of rows, so padding is added once and stays until an operator
mixes rows (attention); its content is never read.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vlatool.graph.nodes import read_names, reads
from vlatool.graph.onnx_graph import FLOAT
from vlatool.quantize.int8._value_forms import FormNames, ValueForms

MIN_ROWS = 32
"""Fewest rows of a product that becomes a convolution; with fewer rows it is bound by memory, not by arithmetic."""
FUSED_OPS = frozenset({"Gelu", "Relu", "Sigmoid", "Tanh", "Mul", "QuantizeLinear", "DequantizeLinear"})
"""Operators that OpenVINO fuses into the convolution before them, or computes in its pixel layout."""
ROWWISE_OPS = FUSED_OPS | {"Add", "Sub", "Div", "Pow", "Sqrt", "Reciprocal", "Neg", "Erf", "Clip", "Cast"}
"""Elementwise operators."""
NEGLIGIBLE_BIAS = 1e-30
"""A bias too small to change a sum. With a bias, OpenVINO scales the sums of an int8 convolution inside its kernel;
without one (zeros are removed) it scales them after copying them as float32."""


def use_convolutions(model: Any) -> int:
    """Rewrite the products of a weight and at least ``MIN_ROWS`` rows in place; return their number.

    A product keeps the name of its node and absorbs a following bias. Values of symbolic shape stay unchanged.

    Args:
        model: An ``onnx.ModelProto`` of opset 13 or later: float32, or with QDQ operators.
    """
    return _ConvolutionRewriter(model).rewrite()


class _ConvolutionRewriter(ValueForms):
    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.merged_biases: set[str] = set()
        self.count = 0

    def rewrite(self) -> int:
        """Rebuild the list of nodes."""
        stored = set(self.constants)
        for node in self.graph.node:
            if node.output[0] in self.merged_biases:
                continue
            if not (self._as_convolution(node) or self._as_pixels(node) or self._as_padded(node)):
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

    def _as_convolution(self, node: Any) -> bool:
        options = self.attributes(node)
        if node.op_type not in ("MatMul", "Gemm") or self.row_count(node.input[0]) < MIN_ROWS:
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
            bias = self.add(f"{value}/bias", np.full(channels, NEGLIGIBLE_BIAS, np.float32))
        image = f"{value}/pixels"
        self.append("Conv", [self.pixels(node.input[0]), weight, *([bias] if bias else [])], image, node.name)
        self.forms[value] = FormNames("pixels", pixels=image)
        self.count += 1
        return True

    def _with_bias(self, value: str, channels: int) -> tuple[str, str]:
        """Return the output of a product after a following bias, and that bias; empty without a bias."""
        readers = self.readers[value]
        if len(readers) == 1 and readers[0].op_type == "Add" and value not in self.outputs:
            others = [name for name in readers[0].input if name != value]
            if len(others) == 1 and self._is_vector(others[0], channels):
                self.merged_biases.add(readers[0].output[0])
                return readers[0].output[0], others[0]
        return value, ""

    def _is_vector(self, name: str, channels: int) -> bool:
        return self.is_weight(name) and list(self.constants[name].dims) == [channels]

    def _weight(self, name: str, *, output_first: bool) -> str:
        """Return a weight (N, K, 1, 1) from one of (K, N) or (N, K); empty when the value is not a weight."""
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

    def _as_pixels(self, node: Any) -> bool:
        """Apply an elementwise operator after a convolution to pixels."""
        value, activations = node.output[0], [name for name in node.input if name and name not in self.constants]
        if node.op_type not in FUSED_OPS or not any(self.native(name) == "pixels" for name in activations):
            return False
        if self._feeds_row_mixing(node):
            return False
        if any(self.shapes.get(name, "?") != self.shapes.get(value) for name in activations):
            return False
        if any(name in self.constants and math.prod(self.constants[name].dims) != 1 for name in node.input):
            return False
        inputs = [self.pixels(name) if name in activations else self.number(name) for name in node.input]
        self.copy(node, inputs, f"{value}/pixels")
        self.forms[value] = FormNames("pixels", pixels=f"{value}/pixels")
        return True

    def _as_padded(self, node: Any) -> bool:
        """Apply an operator with independent rows to the padded form."""
        value, rows = node.output[0], self.row_count(node.output[0])
        inputs = [name for name in node.input if name]
        if len(node.output) != 1 or not rows or not any(self.native(name) in ("padded", "pixels") for name in inputs):
            return False
        if self._feeds_row_mixing(node):
            return False
        activations = [name for name in inputs if self.row_count(name) == rows]
        leading = {self.shapes[name][:-1] for name in (*activations, value)}
        if len(leading) != 1 or not self._is_rowwise(node, [name for name in inputs if name not in activations]):
            return False
        padded = self.padded_name(value)
        copy = self.copy(node, [self.padded_form(name) if name in activations else name for name in node.input], padded)
        self._set_last_axis(copy)
        self.forms[value] = FormNames("padded", rows=value if padded == value else "", padded=padded)
        return True

    def _feeds_row_mixing(self, node: Any) -> bool:
        """Return whether a quantizer feeds an operator that mixes rows: padding is then dropped before it."""
        if node.op_type not in ("QuantizeLinear", "DequantizeLinear"):
            return False
        readers = self.readers[node.output[0]]
        if node.op_type == "QuantizeLinear":
            readers = [reader for dequantize in readers for reader in self.readers[dequantize.output[0]]]
        return not any(reader.op_type in ("MatMul", "Gemm", *ROWWISE_OPS) for reader in readers)

    def _is_rowwise(self, node: Any, others: list[str]) -> bool:
        """Return whether an operator computes rows independently; ``others``: inputs shared by all rows."""
        last = (-1, len(self.shapes.get(node.input[0], ())) - 1)
        if node.op_type == "LayerNormalization":
            return self.attributes(node).get("axis", -1) in last and all(name in self.constants for name in others)
        if node.op_type == "ReduceMean":
            axes = self.attributes(node).get("axes", [])
            if len(node.input) > 1 and node.input[1] in self.constants:
                axes = self.array(node.input[1]).tolist()
            return len(axes) == 1 and axes[0] in last and self.attributes(node).get("keepdims", 1) == 1
        if node.op_type not in ROWWISE_OPS:
            return False
        shapes = [self.shapes.get(name, (0, 0)) for name in others]
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            return all(math.prod(shape) == 1 for shape in shapes)
        return all(len(shape) <= 3 and math.prod(shape[:-1]) == 1 for shape in shapes)

    def _set_last_axis(self, node: Any) -> None:
        """Write the last axis as -1, which holds for any rank."""
        for item in node.attribute:
            if item.name == "axis":
                item.i = -1
            elif item.name == "axes":
                item.ints[:] = [-1]
        if node.op_type == "ReduceMean" and len(node.input) > 1:
            node.input[1] = self.numbers([-1])
