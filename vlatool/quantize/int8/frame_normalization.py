"""Fold the normalisation of a camera frame into the convolution that reads it.

``(pixel - mean) / std`` in front of a convolution equals the convolution with other weights and another bias. Over a
whole frame those products and sums are expensive, and quantizing their result costs accuracy: the pixels themselves are
uint8 already. One level, near the mean of all channels, is still subtracted: it is the zero point of the quantized
frame. Without it the rounding error of each weight would be multiplied by the mean of the frame.

Where the convolution pads, the frame gets a border of the pixels that the normalisation maps to zero: the mean of each
channel, rounded to an integer as a quantizer would.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.runtime.interface import Array

ARITHMETIC = {"Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.divide}
MAX_SCALE_RATIO = 4.0
"""Largest ratio of the scales of two channels: beyond it their weights would need different steps."""


def fold_normalization(model: Any, convolutions: Collection[str]) -> dict[str, tuple[float, float]]:
    """Fold normalisations in place, where nothing else lies between a uint8 frame and a convolution.

    Args:
        model: An ``onnx.ModelProto``.
        convolutions: Names of the nodes that may be changed.

    Returns:
        Input of such a convolution -> its range, which is that of pixels: 255 steps of 1.
    """
    folder = _NormalizationFolder(model)
    ranges: dict[str, tuple[float, float]] = {}
    for node in list(model.graph.node):
        zero = folder.fold(node) if node.op_type == "Conv" and node.name in convolutions else None
        if zero is not None:
            ranges[node.input[0]] = (0.0 - zero, 255.0 - zero)
    return ranges


class _NormalizationFolder(OnnxGraph):
    def fold(self, convolution: Any) -> int | None:
        """Fold the normalisation before a convolution; return the level still subtracted, None when impossible."""
        chain = self._chain(convolution)
        arithmetic = [node for node in chain if node.op_type in ARITHMETIC]
        pads = self._pads(convolution)
        affine = self._affine(chain) if arithmetic and pads is not None else None
        if affine is None or pads is None:
            return None
        weight = self.array(convolution.input[1]).astype(np.float64)
        scale, shift = affine
        border = np.rint(-shift / scale)
        if len(scale) != weight.shape[1] or (any(pads) and not ((border >= 0) & (border <= 255)).all()):
            return None
        zero = int(np.clip(np.rint(np.mean(-shift / scale)), 0, 255))
        self._write_weights(convolution, weight, scale, shift + scale * zero)
        for node in arithmetic:
            self.replace_reads(node.output[0], self._varying(node))  # by its only reader
            self.graph.node.remove(node)
        pixels, centred = chain[0].output[0], f"{convolution.name}.frame"
        self.replace_reads(pixels, centred)
        level = self.add(f"{convolution.name}.pixels.level", [zero], np.float32)
        position = list(self.graph.node).index(chain[0]) + 1
        self.graph.node.insert(position, self.node("Sub", [pixels, level], [centred], f"{convolution.name}/frame"))
        if any(pads):
            self._add_border(chain, pads, border, convolution)
        return zero

    def _chain(self, convolution: Any) -> list[Any]:
        """Return the nodes from the Cast of a frame to a convolution; none when others read the values in between."""
        chain: list[Any] = []
        value, uint8 = convolution.input[0], self.onnx.TensorProto.UINT8
        while True:
            node = self.producers.get(value)
            if node is None or len(self.readers[value]) != 1 or value in self.outputs:
                return []
            chain.insert(0, node)
            if node.op_type == "Cast":
                return chain if self.types.get(node.input[0]) == uint8 else []
            if node.op_type in ARITHMETIC:
                value = self._varying(node)
            elif node.op_type == "Transpose":
                value = node.input[0]
            else:
                return []

    def _varying(self, node: Any) -> str:
        """Return the operand that is not a constant; empty when both vary, or a constant is divided."""
        left, right = node.input
        if right in self.constants:
            return str(left)
        return str(right) if left in self.constants and node.op_type in ("Add", "Mul") else ""

    def _pads(self, convolution: Any) -> list[int] | None:
        """Return the padding of a 2-D convolution with constant weights of one group; None for any other."""
        options = self.attributes(convolution)
        constant = all(name in self.constants for name in convolution.input[1:] if name)
        explicit = options.get("auto_pad", b"NOTSET") in (b"NOTSET", b"VALID")
        pads = list(options.get("pads", (0, 0, 0, 0)))
        plain = constant and explicit and options.get("group", 1) == 1
        return pads if plain and len(pads) == 4 and min(pads) >= 0 else None

    def _affine(self, chain: list[Any]) -> tuple[Array, Array] | None:
        """Return scale and shift of each channel, float64 (C,), when the chain treats all its pixels alike."""
        shape = self.shapes.get(chain[0].input[0], ())
        if len(shape) != 4 or not all(shape) or chain[0].output[0] in self.outputs:
            return None
        black, white = (self._apply(chain[1:], np.full(shape, level, np.float64)) for level in (0.0, 1.0))
        if black is None or white is None:
            return None
        per_channel = [np.moveaxis(frame, 1, 0).reshape(frame.shape[1], -1) for frame in (white - black, black)]
        if any(np.ptp(pixels, axis=1).any() for pixels in per_channel):
            return None
        scale, shift = (pixels[:, 0] for pixels in per_channel)
        sizes = np.abs(scale)
        even = np.isfinite(sizes).all() and np.isfinite(shift).all() and sizes.min() > 0
        return (scale, shift) if even and sizes.max() <= MAX_SCALE_RATIO * sizes.min() else None

    def _apply(self, nodes: list[Any], values: Array) -> Array | None:
        for node in nodes:
            if node.op_type == "Transpose":
                values = values.transpose(self.attributes(node).get("perm"))
                continue
            first, second = (self.array(name) if name in self.constants else values for name in node.input)
            before = values.shape
            with np.errstate(all="ignore"):
                values = ARITHMETIC[node.op_type](first, second)
            if values.shape != before:
                return None
        return values

    def _write_weights(self, convolution: Any, weight: Array, scale: Array, shift: Array) -> None:
        """Give a convolution new weights and a new bias for pixels."""
        spread = (1, -1, *[1] * (weight.ndim - 2))
        bias = (weight * shift.reshape(spread)).sum(axis=tuple(range(1, weight.ndim)))
        if len(convolution.input) > 2 and convolution.input[2]:
            bias = bias + self.array(convolution.input[2]).astype(np.float64)
        name = f"{convolution.name}.pixels"
        convolution.input[1] = self.add(f"{name}.weight", weight * scale.reshape(spread), np.float32)
        convolution.input[2:] = [self.add(f"{name}.bias", bias, np.float32)]

    def _add_border(self, chain: list[Any], pads: list[int], border: Array, convolution: Any) -> None:
        """Add a border of the pixel ``border``, (C,), to a frame, instead of the padding of the convolution."""
        axes = np.arange(4)  # axis of the frame for each axis of the convolution's input
        for node in (node for node in chain if node.op_type == "Transpose"):
            axes = axes[self.attributes(node).get("perm", [3, 2, 1, 0])]
        value, shape = chain[0].input[0], list(self.shapes[chain[0].input[0]])
        pixel = np.moveaxis(border.reshape(-1, 1, 1, 1), 0, axes[1])
        for number, axis in enumerate(axes[2:]):
            parts = [value]
            for where, size in (("before", pads[number]), ("after", pads[number + 2])):
                if size:
                    sizes = [size if other == axis else length for other, length in enumerate(shape)]
                    name = f"{convolution.name}.pixels.{where}.{number}"
                    rim = self.add(name, np.broadcast_to(pixel, sizes), np.uint8)
                    parts = [rim, *parts] if where == "before" else [*parts, rim]
            if len(parts) == 1:
                continue
            value, name = f"{convolution.name}.pixels.wide.{number}", f"{convolution.name}/pixels.wide.{number}"
            shape[axis] += pads[number] + pads[number + 2]
            self.insert_before(chain[0], self.node("Concat", parts, [value], name, axis=int(axis)))
        chain[0].input[0] = value
        options = [item for item in convolution.attribute if item.name not in ("pads", "auto_pad")]
        del convolution.attribute[:]
        convolution.attribute.extend(options)
