"""Products with weights as 1 x 1 convolutions over padded rows, which OpenVINO computes faster on matrix units (AMX).

A product of M rows is a convolution over an image of 1 x M pixels. Matrix units take rows in tiles of 16; OpenVINO's
convolution uses them better than its matrix product does, above all when the tiles are full. A row never looks at
another one in a product, in an elementwise operator or in the normalisation of rows, so that rows are added once and
stay until something mixes rows (attention); what they hold is never read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.quantize._nodes import read_names, reads
from vlatool.quantize._value_types import static_shapes

TILE = 16
"""Rows that a matrix unit takes at a time; halves are nearly as good."""
WORTH = 1.05
"""Full tiles are worth this much more rows: of 113, 120 beat 128; of 50, 56 beat 64; of 197, 208 beat 200."""
FEWEST = 32
"""Rows from which a product is written as a convolution; fewer are a matter of memory, not of arithmetic."""
FUSED = frozenset({"Gelu", "Relu", "Sigmoid", "Tanh", "Mul", "QuantizeLinear", "DequantizeLinear"})
"""Operators that OpenVINO computes within the convolution that they follow, or over its pixels as they lie."""
BY_ROW = FUSED | {"Add", "Sub", "Div", "Pow", "Sqrt", "Reciprocal", "Neg", "Erf", "Clip", "Cast"}
"""Operators that compute each element by itself."""
SMALL = 1e-30
"""A bias that changes no sum. With a bias OpenVINO scales an int8 convolution's sums within it; without one (zeros are
removed) it does so after copying them as float32."""
FLOAT = 1  # onnx.TensorProto.FLOAT


@dataclass
class _Forms:
    """Names of a value of M rows.

    Args:
        native: ``rows``, ``padded`` or ``pixels``: how it is computed.
        rows: As it was; empty until somebody reads it.
        padded: (1, M', C), M' of ``padded_rows``.
        pixels: (1, C, 1, M').
    """

    native: str
    rows: str = ""
    padded: str = ""
    pixels: str = ""


def use_convolutions(model: Any) -> int:
    """Rewrite the products of a weight and at least ``FEWEST`` rows in place; return how many there were.

    Nodes keep their names. What depends on a symbolic shape stays as it is.

    Args:
        model: An ``onnx.ModelProto`` of opset 13 or later: float32, or with QDQ operators.
    """
    return _Rewriter(model).rewrite()


def padded_rows(rows: int) -> int:
    """Return the number of rows that a product of so many is computed with."""
    half, whole = (-(-rows // tile) * tile for tile in (TILE // 2, TILE))
    return whole if whole <= WORTH * half else half


@dataclass
class _Rewriter:
    model: Any
    forms: dict[str, _Forms] = field(default_factory=dict)
    nodes: list[Any] = field(default_factory=list)
    merged: set[str] = field(default_factory=set)
    count: int = 0

    def __post_init__(self) -> None:
        self.onnx = require("onnx", "build")
        self.graph = self.model.graph
        self.constants = {tensor.name: tensor for tensor in self.graph.initializer}
        self.shapes = static_shapes(self.model)
        self.producers = {name: node for node in self.graph.node for name in node.output}
        self.outputs = {value.name for value in self.graph.output}
        self.readers: dict[str, list[Any]] = {}
        for node in self.graph.node:
            for name in reads(node):
                self.readers.setdefault(name, []).append(node)

    def rewrite(self) -> int:
        """Rebuild the list of nodes."""
        for node in list(self.graph.node):
            if node.output[0] in self.merged:
                continue
            if not (self._product(node) or self._in_pixels(node) or self._in_padded(node)):
                for name in reads(node):
                    self._rows(name)
                self.nodes.append(node)
        for value in self.graph.output:
            self._rows(value.name)
        if self.count:
            read = read_names(self.nodes) | self.outputs
            self.nodes = [node for node in self.nodes if node.op_type != "DequantizeLinear" or node.output[0] in read]
            used = read_names(self.nodes) | self.outputs
            kept = [tensor for tensor in self.constants.values() if tensor.name in used]
            del self.graph.node[:], self.graph.initializer[:], self.graph.value_info[:]
            self.graph.node.extend(self.nodes)
            self.graph.initializer.extend(kept)
        return self.count

    # ---- what is rewritten

    def _product(self, node: Any) -> bool:
        options = self._options(node)
        if node.op_type not in ("MatMul", "Gemm") or self._height(node.input[0]) < FEWEST:
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
            bias = self._constant(f"{value}/bias", np.full(channels, SMALL, np.float32))
        image = f"{value}/pixels"
        self._add("Conv", [self._pixels(node.input[0]), weight, *([bias] if bias else [])], image, node.name)
        self.forms[value] = _Forms("pixels", pixels=image)
        self.count += 1
        return True

    def _with_bias(self, value: str, channels: int) -> tuple[str, str]:
        """Return what a product gives with the bias that is added next, and that bias; empty when there is none."""
        readers = self.readers.get(value, [])
        if len(readers) == 1 and readers[0].op_type == "Add" and value not in self.outputs:
            others = [name for name in readers[0].input if name != value]
            if len(others) == 1 and self._is_vector(others[0], channels):
                self.merged.add(readers[0].output[0])
                return readers[0].output[0], others[0]
        return value, ""

    def _is_vector(self, name: str, channels: int) -> bool:
        tensor = self.constants.get(name)
        return tensor is not None and list(tensor.dims) == [channels] and tensor.data_type == FLOAT

    def _weight(self, name: str, *, output_first: bool) -> str:
        """Return a weight (N, K, 1, 1) made of one (K, N), or (N, K); empty when the value is no weight."""
        made = f"{name}/{'nk' if output_first else 'kn'}"
        tensor = self.constants.get(name)
        if tensor is not None:
            fits = len(tensor.dims) == 2 and tensor.data_type == FLOAT
            return self._image_of(name, made, output_first) if fits else ""
        node = self.producers.get(name)
        if node is None or node.op_type != "DequantizeLinear" or any(each not in self.constants for each in node.input):
            return ""
        stored, scale = self.constants[node.input[0]], self.constants[node.input[1]]
        axis = self._options(node).get("axis", 1) % 2
        by_channel = len(scale.dims) == 1 and axis == (0 if output_first else 1)
        if len(stored.dims) != 2 or scale.data_type != FLOAT or not (by_channel or not scale.dims):
            return ""
        if made not in self.shapes:
            image = self._image_of(node.input[0], f"{made}/stored", output_first)
            self._add(
                "DequantizeLinear", [image, *node.input[1:]], made, node.name, **({"axis": 0} if by_channel else {})
            )
            self.shapes[made] = ()
        return made

    def _image_of(self, name: str, made: str, output_first: bool) -> str:
        if made in self.constants:
            return made
        values = self._array(name)
        return self._constant(made, (values if output_first else values.T)[:, :, None, None])

    def _in_pixels(self, node: Any) -> bool:
        """Write an elementwise operator after a convolution as one of pixels."""
        value, moving = node.output[0], [name for name in node.input if name and name not in self.constants]
        if node.op_type not in FUSED or not any(self._native(name) == "pixels" for name in moving):
            return False
        if any(self.shapes.get(name, "?") != self.shapes.get(value) for name in moving):
            return False
        if any(name in self.constants and math.prod(self.constants[name].dims) != 1 for name in node.input):
            return False
        inputs = [self._pixels(name) if name in moving else self._number(name) for name in node.input]
        self._copy(node, inputs, f"{value}/pixels")
        self.forms[value] = _Forms("pixels", pixels=f"{value}/pixels")
        return True

    def _in_padded(self, node: Any) -> bool:
        """Let an operator that works on each row by itself work on more rows."""
        value, high = node.output[0], self._height(node.output[0])
        inputs = [name for name in node.input if name]
        if len(node.output) != 1 or not high or not any(self._native(name) in ("padded", "pixels") for name in inputs):
            return False
        moving = [name for name in inputs if self._height(name) == high]
        leading = {self.shapes[name][:-1] for name in (*moving, value)}
        if len(leading) != 1 or not self._by_row(node, [name for name in inputs if name not in moving]):
            return False
        made = self._padded_name(value)
        copy = self._copy(node, [self._padded(name) if name in moving else name for name in node.input], made)
        self._last_axis(copy)
        self.forms[value] = _Forms("padded", rows=value if made == value else "", padded=made)
        return True

    def _by_row(self, node: Any, others: list[str]) -> bool:
        """Say whether an operator computes each row by itself; ``others`` are inputs that are the same for all rows."""
        last = (-1, len(self.shapes[node.input[0]]) - 1)
        if node.op_type == "LayerNormalization":
            return self._options(node).get("axis", -1) in last and all(name in self.constants for name in others)
        if node.op_type == "ReduceMean":
            axes = self._options(node).get("axes", [])
            if len(node.input) > 1 and node.input[1] in self.constants:
                axes = self._array(node.input[1]).tolist()
            return len(axes) == 1 and axes[0] in last and self._options(node).get("keepdims", 1) == 1
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
            node.input[1] = self._numbers([-1])

    # ---- forms

    def _height(self, name: str) -> int:
        """Return M of a value (..., C) of fixed shape, its leading axes multiplied; 0 for others."""
        shape = self.shapes.get(name, ())
        return math.prod(shape[:-1]) if len(shape) > 1 and name not in self.constants else 0

    def _native(self, name: str) -> str:
        return self.forms[name].native if name in self.forms else ""

    def _form(self, name: str) -> _Forms:
        return self.forms.setdefault(name, _Forms("rows", rows=name))

    def _more(self, name: str) -> int:
        return padded_rows(self._height(name)) - self._height(name)

    def _padded_name(self, name: str) -> str:
        same = not self._more(name) and self.shapes[name][:-1] == (1, self._height(name))
        return name if same else f"{name}/padded"

    def _rows(self, name: str) -> None:
        """Bring a value into being as it was."""
        forms = self.forms.get(name)
        if forms is None or forms.rows:
            return
        forms.rows = name
        value, shape = self._padded(name), self.shapes[name]
        flat = shape[:-1] == (1, self._height(name))
        if self._more(name):
            bounds = [self._numbers([number]) for number in (0, self._height(name), 1)]
            cut = name if flat else f"{name}/rows"
            self._add("Slice", [value, *bounds], cut, f"{name}/rows")
            value = cut
        if not flat:
            self._add("Reshape", [value, self._numbers(list(shape))], name, f"{name}/shape")

    def _padded(self, name: str) -> str:
        forms = self._form(name)
        if forms.padded:
            return forms.padded
        forms.padded = self._padded_name(name)
        height, more, channels = self._height(name), self._more(name), self.shapes[name][-1]
        if forms.native == "pixels":
            flat = f"{name}/flat"
            self._add("Reshape", [forms.pixels, self._numbers([1, channels, height + more])], flat, flat)
            self._add("Transpose", [flat], forms.padded, forms.padded, perm=[0, 2, 1])
            return forms.padded
        value = name
        if self.shapes[name][:-1] != (1, height):
            value = f"{name}/merged" if more else forms.padded
            self._add("Reshape", [name, self._numbers([1, height, channels])], value, value)
        if more:
            self._add("Pad", [value, self._numbers([0, 0, 0, 0, more, 0])], forms.padded, forms.padded)
        return forms.padded

    def _pixels(self, name: str) -> str:
        forms = self._form(name)
        if not forms.pixels:
            turned, forms.pixels = f"{name}/turned", f"{name}/pixels"
            shape = [1, self.shapes[name][-1], 1, self._height(name) + self._more(name)]
            self._add("Transpose", [self._padded(name)], turned, turned, perm=[0, 2, 1])
            self._add("Reshape", [turned, self._numbers(shape)], forms.pixels, forms.pixels)
        return forms.pixels

    # ---- writing

    def _options(self, node: Any) -> dict[str, Any]:
        return {item.name: self.onnx.helper.get_attribute_value(item) for item in node.attribute}

    def _array(self, name: str) -> Any:
        return self.onnx.numpy_helper.to_array(self.constants[name])

    def _constant(self, name: str, values: Any) -> str:
        self.constants[name] = self.onnx.numpy_helper.from_array(np.ascontiguousarray(values), name)
        return name

    def _number(self, name: str) -> str:
        """Return a constant of one element without axes, which could meet those of an image."""
        if not name or not self.constants[name].dims:
            return name
        made = f"{name}/number"
        return made if made in self.constants else self._constant(made, self._array(name).reshape(()))

    def _numbers(self, values: list[int]) -> str:
        name = "pixels/" + "_".join(map(str, values))
        return name if name in self.constants else self._constant(name, np.array(values, np.int64))

    def _add(self, kind: str, inputs: list[str], output: str, name: str, **options: Any) -> None:
        self.nodes.append(self.onnx.helper.make_node(kind, inputs, [output], name=name, **options))

    def _copy(self, node: Any, inputs: list[str], output: str) -> Any:
        copy = type(node)()
        copy.CopyFrom(node)
        del copy.input[:], copy.output[:]
        copy.input.extend(inputs)
        copy.output.append(output)
        self.nodes.append(copy)
        return copy
