"""Forms of the values of a graph whose products become convolutions: original, padded with rows, or as an image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.graph.onnx_graph import OnnxGraph

TILE = 16
"""Rows of a tile of a matrix unit; half tiles are nearly as good."""
FULL_TILE_TOLERANCE = 1.05
"""Largest ratio of rows in full to half tiles: for 113, 120 beats 128; for 50, 56 beats 64; for 197, 208 beats 200."""


@dataclass
class FormNames:
    """Names of a value of M rows in its forms; empty until a node reads that form.

    Args:
        native: Form that is computed: ``rows``, ``padded`` or ``pixels``.
        rows: Original form.
        padded: Form (1, M', C), M' of ``padded_rows``.
        pixels: Form (1, C, 1, M').
    """

    native: str
    rows: str = ""
    padded: str = ""
    pixels: str = ""


def padded_rows(rows: int) -> int:
    """Return the number of rows after padding."""
    half, whole = (-(-rows // tile) * tile for tile in (TILE // 2, TILE))
    return whole if whole <= FULL_TILE_TOLERANCE * half else half


class ValueForms(OnnxGraph):
    """An ``onnx.ModelProto`` that is rebuilt node by node, and the forms of its values that exist so far."""

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.forms: dict[str, FormNames] = {}
        self.nodes: list[Any] = []

    def row_count(self, name: str) -> int:
        """Return M of a value (..., C) of static shape, the product of its leading axes; 0 for others."""
        shape = self.shapes.get(name, ())
        return math.prod(shape[:-1]) if len(shape) > 1 and name not in self.constants else 0

    def native(self, name: str) -> str:
        """Return the native form of a value; empty when it has not been visited yet."""
        return self.forms[name].native if name in self.forms else ""

    def _form(self, name: str) -> FormNames:
        return self.forms.setdefault(name, FormNames("rows", rows=name))

    def _padding(self, name: str) -> int:
        return padded_rows(self.row_count(name)) - self.row_count(name)

    def padded_name(self, name: str) -> str:
        """Return the name of the padded form: the value's own name when padding changes nothing."""
        same = not self._padding(name) and self.shapes[name][:-1] == (1, self.row_count(name))
        return name if same else f"{name}/padded"

    def rows(self, name: str) -> None:
        """Create the original form of a value."""
        forms = self.forms.get(name)
        if forms is None or forms.rows:
            return
        forms.rows = name
        value, shape = self.padded_form(name), self.shapes[name]
        flat = shape[:-1] == (1, self.row_count(name))
        if self._padding(name):
            bounds = [self.numbers([number]) for number in (0, self.row_count(name), 1)]
            cut = name if flat else f"{name}/rows"
            self.append("Slice", [value, *bounds], cut, f"{name}/rows")
            value = cut
        if not flat:
            self.append("Reshape", [value, self.numbers(list(shape))], name, f"{name}/shape")

    def padded_form(self, name: str) -> str:
        """Return the name of the padded form, (1, M', C); created at its first use."""
        forms = self._form(name)
        if forms.padded:
            return forms.padded
        forms.padded = self.padded_name(name)
        rows, padding, channels = self.row_count(name), self._padding(name), self.shapes[name][-1]
        if forms.native == "pixels":
            flat = f"{name}/flat"
            self.append("Reshape", [forms.pixels, self.numbers([1, channels, rows + padding])], flat, flat)
            self.append("Transpose", [flat], forms.padded, forms.padded, perm=[0, 2, 1])
            return forms.padded
        value = name
        if self.shapes[name][:-1] != (1, rows):
            value = f"{name}/merged" if padding else forms.padded
            self.append("Reshape", [name, self.numbers([1, rows, channels])], value, value)
        if padding:
            self.append("Pad", [value, self.numbers([0, 0, 0, 0, padding, 0])], forms.padded, forms.padded)
        return forms.padded

    def pixels(self, name: str) -> str:
        """Return the name of the image form, (1, C, 1, M'); created at its first use."""
        forms = self._form(name)
        if not forms.pixels:
            transposed, forms.pixels = f"{name}/turned", f"{name}/pixels"
            shape = [1, self.shapes[name][-1], 1, self.row_count(name) + self._padding(name)]
            self.append("Transpose", [self.padded_form(name)], transposed, transposed, perm=[0, 2, 1])
            self.append("Reshape", [transposed, self.numbers(shape)], forms.pixels, forms.pixels)
        return forms.pixels

    # ---- writing

    def number(self, name: str) -> str:
        """Return a constant of one element with one axis, since its own axes could clash with those of an image."""
        if not name or not self.constants[name].dims:
            return name
        return self.add(f"{name}/number", self.array(name).reshape(1))

    def numbers(self, values: list[int]) -> str:
        """Return the name of a constant of integers, shared by all its readers."""
        return self.add("pixels/" + "_".join(map(str, values)), values, np.int64)

    def append(self, kind: str, inputs: list[str], output: str, name: str, **options: Any) -> None:
        """Add a node."""
        self.nodes.append(self.node(kind, inputs, [output], name, **options))

    def copy(self, node: Any, inputs: list[str], output: str) -> Any:
        """Add a copy of a node with other inputs and another output; return it."""
        copy = type(node)()
        copy.CopyFrom(node)
        copy.input[:], copy.output[:] = inputs, [output]
        self.nodes.append(copy)
        return copy
