"""Fold the normalisation of a camera frame into the convolution that reads it.

``(pixel - mean) / std`` in front of a convolution is the convolution with other weights and another bias. Over a whole
frame those products and sums cost more than they look, and quantizing their result costs accuracy: the pixels
themselves are uint8 already. One level, near the mean of all channels, stays subtracted: it is the zero point of the
quantized frame. Without it each weight's rounding error would be multiplied by the mean of the frame.

Where the convolution pads, the frame gets a border of pixels that are what zeros are after the normalisation: each
channel's mean, rounded to a whole pixel as quantizing it would.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import require
from vlatool.graph.nodes import reads
from vlatool.graph.types import inferred_values

Array = NDArray[Any]
ARITHMETIC = {"Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.divide}
UNEVEN = 4.0
"""Largest ratio of two channels' scales: beyond it their weights would need different steps."""


def fold_frames(model: Any, convolutions: Collection[str]) -> dict[str, tuple[float, float]]:
    """Fold normalisations in place, where a frame of uint8 reaches a convolution through nothing else.

    Args:
        model: An ``onnx.ModelProto``.
        convolutions: Names of the nodes that may be changed.

    Returns:
        Value that such a convolution reads -> its range, which is that of pixels: 255 steps of 1.
    """
    folder = _Folder(model)
    found: dict[str, tuple[float, float]] = {}
    for node in list(model.graph.node):
        zero = folder.fold(node) if node.op_type == "Conv" and node.name in convolutions else None
        if zero is not None:
            found[node.input[0]] = (0.0 - zero, 255.0 - zero)
    return found


def _frames(model: Any, uint8: int) -> dict[str, list[int]]:
    """Return the shapes of the values of type uint8, 0 for a size that is not fixed."""
    kinds = {value.name: value.type.tensor_type for value in inferred_values(model)}
    return {
        name: [axis.dim_value for axis in kind.shape.dim] for name, kind in kinds.items() if kind.elem_type == uint8
    }


class _Folder:
    def __init__(self, model: Any) -> None:
        self.onnx = require("onnx", "build")
        self.graph = model.graph
        self.constants = {tensor.name: tensor for tensor in model.graph.initializer}
        self.producers = {name: node for node in model.graph.node for name in node.output}
        self.readers = Counter(name for node in model.graph.node for name in reads(node))
        self.outputs = {value.name for value in model.graph.output}
        self.frames = _frames(model, self.onnx.TensorProto.UINT8)

    def fold(self, convolution: Any) -> int | None:
        """Fold what is before a convolution; return the level that stays subtracted, None when it cannot be folded."""
        chain = self._chain(convolution)
        arithmetic = [node for node in chain if node.op_type in ARITHMETIC]
        pads = self._pads(convolution)
        found = self._affine(chain) if arithmetic and pads is not None else None
        if found is None or pads is None:
            return None
        weight = self._array(convolution.input[1]).astype(np.float64)
        scale, shift = found
        border = np.rint(-shift / scale)
        if len(scale) != weight.shape[1] or (any(pads) and not ((border >= 0) & (border <= 255)).all()):
            return None
        zero = int(np.clip(np.rint(np.mean(-shift / scale)), 0, 255))
        self._rewrite(convolution, weight, scale, shift + scale * zero)
        for node in arithmetic:
            self._bypass(node)
        self._subtract(chain[0], zero, convolution.name)
        if any(pads):
            self._surround(chain, pads, border, convolution)
        return zero

    def _chain(self, convolution: Any) -> list[Any]:
        """Return the nodes from a frame's Cast to a convolution; none when others read what is between."""
        found: list[Any] = []
        value = convolution.input[0]
        while True:
            node = self.producers.get(value)
            if node is None or self.readers[value] != 1 or value in self.outputs:
                return []
            found.append(node)
            if node.op_type == "Cast":
                return found[::-1] if node.input[0] in self.frames else []
            if node.op_type in ARITHMETIC:
                value = self._varying(node)
            elif node.op_type == "Transpose":
                value = node.input[0]
            else:
                return []

    def _varying(self, node: Any) -> str:
        """Return the operand that is no constant; nothing when both are none, or a constant is divided."""
        left, right = node.input
        if right in self.constants:
            return str(left)
        return str(right) if left in self.constants and node.op_type in ("Add", "Mul") else ""

    def _pads(self, convolution: Any) -> list[int] | None:
        """Return the padding of a convolution with constant weights of one group, two axes; None of any other."""
        attributes = {item.name: self.onnx.helper.get_attribute_value(item) for item in convolution.attribute}
        constant = all(name in self.constants for name in convolution.input[1:] if name)
        told = attributes.get("auto_pad", b"NOTSET") in (b"NOTSET", b"VALID")
        pads = list(attributes.get("pads", (0, 0, 0, 0)))
        plain = constant and told and attributes.get("group", 1) == 1
        return pads if plain and len(pads) == 4 and min(pads) >= 0 else None

    def _affine(self, chain: list[Any]) -> tuple[Array, Array] | None:
        """Return scale and shift of each channel, float64 (C,), when the chain does the same to all its pixels."""
        shape = self.frames[chain[0].input[0]]
        if len(shape) != 4 or not all(shape) or chain[0].output[0] in self.outputs:
            return None
        black, white = (self._through(chain[1:], np.full(shape, level, np.float64)) for level in (0.0, 1.0))
        if black is None or white is None:
            return None
        per_channel = [np.moveaxis(each, 1, 0).reshape(each.shape[1], -1) for each in (white - black, black)]
        if any(np.ptp(each, axis=1).any() for each in per_channel):
            return None
        scale, shift = (each[:, 0] for each in per_channel)
        sizes = np.abs(scale)
        even = np.isfinite(sizes).all() and np.isfinite(shift).all() and sizes.min() > 0
        return (scale, shift) if even and sizes.max() <= UNEVEN * sizes.min() else None

    def _through(self, nodes: list[Any], values: Array) -> Array | None:
        for node in nodes:
            if node.op_type == "Transpose":
                axes = {item.name: list(item.ints) for item in node.attribute}.get("perm")
                values = values.transpose(axes)
                continue
            first, second = (self._array(name) if name in self.constants else values for name in node.input)
            before = values.shape
            with np.errstate(all="ignore"):
                values = ARITHMETIC[node.op_type](first, second)
            if values.shape != before:
                return None
        return values

    def _rewrite(self, convolution: Any, weight: Array, scale: Array, shift: Array) -> None:
        """Give a convolution weights and bias of its own that read pixels."""
        spread = (1, -1, *[1] * (weight.ndim - 2))
        bias = (weight * shift.reshape(spread)).sum(axis=tuple(range(1, weight.ndim)))
        if len(convolution.input) > 2 and convolution.input[2]:
            bias = bias + self._array(convolution.input[2]).astype(np.float64)
        name = convolution.name
        inputs = [
            convolution.input[0],
            self._constant(f"{name}.pixels.weight", weight * scale.reshape(spread)),
            self._constant(f"{name}.pixels.bias", bias),
        ]
        del convolution.input[:]
        convolution.input.extend(inputs)

    def _bypass(self, node: Any) -> None:
        """Let the one reader of a node read what the node reads."""
        self._replace(node.output[0], self._varying(node))
        self.graph.node.remove(node)

    def _replace(self, old: str, new: str) -> None:
        for reader in self.graph.node:
            for index, name in enumerate(reader.input):
                if name == old:
                    reader.input[index] = new

    def _subtract(self, cast: Any, zero: int, name: str) -> None:
        """Subtract a level from a frame, for the one reader that it has."""
        pixels, centred = cast.output[0], f"{name}.frame"
        self._replace(pixels, centred)
        inputs = [pixels, self._constant(f"{name}.pixels.level", np.array(zero))]
        place = list(self.graph.node).index(cast) + 1
        self.graph.node.insert(place, self.onnx.helper.make_node("Sub", inputs, [centred], name=f"{name}/frame"))

    def _surround(self, chain: list[Any], pads: list[int], border: Array, convolution: Any) -> None:
        """Join a frame with a border of pixels, and let the convolution pad no more.

        Args:
            chain: From the Cast to the convolution.
            pads: Rows and columns before, rows and columns after.
            border: A pixel, (C,).
            convolution: Its padding is taken away.
        """
        axes = np.arange(4)  # which axis of the frame each axis of what the convolution reads is
        for node in (node for node in chain if node.op_type == "Transpose"):
            axes = axes[{item.name: list(item.ints) for item in node.attribute}.get("perm", [3, 2, 1, 0])]
        value, shape = chain[0].input[0], list(self.frames[chain[0].input[0]])
        place = list(self.graph.node).index(chain[0])
        pixel = np.moveaxis(border.reshape(-1, 1, 1, 1), 0, axes[1])
        for number, axis in enumerate(axes[2:]):
            parts = [value]
            for where, size in (("before", pads[number]), ("after", pads[number + 2])):
                if size:
                    sizes = [size if each == axis else length for each, length in enumerate(shape)]
                    name = f"{convolution.name}.pixels.{where}.{number}"
                    filled = self._constant(name, np.broadcast_to(pixel, sizes), np.uint8)
                    parts = [filled, *parts] if where == "before" else [*parts, filled]
            if len(parts) == 1:
                continue
            value, shape[axis] = (
                f"{convolution.name}.pixels.wide.{number}",
                shape[axis] + pads[number] + pads[number + 2],
            )
            name = f"{convolution.name}/pixels.wide.{number}"
            made = self.onnx.helper.make_node("Concat", parts, [value], name=name, axis=int(axis))
            self.graph.node.insert(place, made)
            place += 1
        chain[0].input[0] = value
        kept = [item for item in convolution.attribute if item.name not in ("pads", "auto_pad")]
        del convolution.attribute[:]
        convolution.attribute.extend(kept)

    def _array(self, name: str) -> Array:
        found: Array = self.onnx.numpy_helper.to_array(self.constants[name])
        return found

    def _constant(self, name: str, values: Array, dtype: type = np.float32) -> str:
        tensor = self.onnx.numpy_helper.from_array(np.ascontiguousarray(values, dtype), name)
        self.constants[name] = tensor
        self.graph.initializer.append(tensor)
        return name
