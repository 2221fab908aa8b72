"""The forms of the values of a graph whose products become convolutions: as they were, with rows added, as an image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.graph.onnx_graph import OnnxGraph

TILE = 16
"""Rows that a matrix unit takes at a time; halves are nearly as good."""
FULL_TILES = 1.05
"""Full tiles may take this many times the rows: of 113, 120 beat 128; of 50, 56 beat 64; of 197, 208 beat 200."""


@dataclass
class Names:
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


def padded_rows(rows: int) -> int:
    """Return the number of rows that a product of so many is computed with."""
    half, whole = (-(-rows // tile) * tile for tile in (TILE // 2, TILE))
    return whole if whole <= FULL_TILES * half else half


class Forms(OnnxGraph):
    """A graph that is rebuilt node by node, and the forms of its values that were needed so far.

    Args:
        model: An ``onnx.ModelProto``.
    """

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        self.forms: dict[str, Names] = {}
        self.nodes: list[Any] = []

    def height(self, name: str) -> int:
        """Return M of a value (..., C) of fixed shape, its leading axes multiplied; 0 for others."""
        shape = self.shapes.get(name, ())
        return math.prod(shape[:-1]) if len(shape) > 1 and name not in self.constants else 0

    def native(self, name: str) -> str:
        """Return how a value is computed; empty when it was not looked at yet."""
        return self.forms[name].native if name in self.forms else ""

    def _form(self, name: str) -> Names:
        return self.forms.setdefault(name, Names("rows", rows=name))

    def _more(self, name: str) -> int:
        return padded_rows(self.height(name)) - self.height(name)

    def padded_name(self, name: str) -> str:
        """Return what the value with rows added is called: its own name when that is the value as it was."""
        same = not self._more(name) and self.shapes[name][:-1] == (1, self.height(name))
        return name if same else f"{name}/padded"

    def rows(self, name: str) -> None:
        """Bring a value into being as it was."""
        forms = self.forms.get(name)
        if forms is None or forms.rows:
            return
        forms.rows = name
        value, shape = self.padded(name), self.shapes[name]
        flat = shape[:-1] == (1, self.height(name))
        if self._more(name):
            bounds = [self.numbers([number]) for number in (0, self.height(name), 1)]
            cut = name if flat else f"{name}/rows"
            self.append("Slice", [value, *bounds], cut, f"{name}/rows")
            value = cut
        if not flat:
            self.append("Reshape", [value, self.numbers(list(shape))], name, f"{name}/shape")

    def padded(self, name: str) -> str:
        """Return the name of a value with rows added, (1, M', C); made at its first use."""
        forms = self._form(name)
        if forms.padded:
            return forms.padded
        forms.padded = self.padded_name(name)
        height, more, channels = self.height(name), self._more(name), self.shapes[name][-1]
        if forms.native == "pixels":
            flat = f"{name}/flat"
            self.append("Reshape", [forms.pixels, self.numbers([1, channels, height + more])], flat, flat)
            self.append("Transpose", [flat], forms.padded, forms.padded, perm=[0, 2, 1])
            return forms.padded
        value = name
        if self.shapes[name][:-1] != (1, height):
            value = f"{name}/merged" if more else forms.padded
            self.append("Reshape", [name, self.numbers([1, height, channels])], value, value)
        if more:
            self.append("Pad", [value, self.numbers([0, 0, 0, 0, more, 0])], forms.padded, forms.padded)
        return forms.padded

    def pixels(self, name: str) -> str:
        """Return the name of a value as an image, (1, C, 1, M'); made at its first use."""
        forms = self._form(name)
        if not forms.pixels:
            turned, forms.pixels = f"{name}/turned", f"{name}/pixels"
            shape = [1, self.shapes[name][-1], 1, self.height(name) + self._more(name)]
            self.append("Transpose", [self.padded(name)], turned, turned, perm=[0, 2, 1])
            self.append("Reshape", [turned, self.numbers(shape)], forms.pixels, forms.pixels)
        return forms.pixels

    # ---- writing

    def number(self, name: str) -> str:
        """Return a constant of one element with one axis, since its own could meet those of an image."""
        if not name or not self.constants[name].dims:
            return name
        return self.add(f"{name}/number", self.array(name).reshape(1))

    def numbers(self, values: list[int]) -> str:
        """Return the name of a constant of whole numbers, shared by all that need it."""
        return self.add("pixels/" + "_".join(map(str, values)), values, np.int64)

    def append(self, kind: str, inputs: list[str], output: str, name: str, **options: Any) -> None:
        """Add a node."""
        self.nodes.append(self.node(kind, inputs, [output], name, **options))

    def copy(self, node: Any, inputs: list[str], output: str) -> Any:
        """Add a node like another one, with other inputs and another output; return it."""
        copy = type(node)()
        copy.CopyFrom(node)
        copy.input[:], copy.output[:] = inputs, [output]
        self.nodes.append(copy)
        return copy
