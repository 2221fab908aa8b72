"""Put float8 (E4M3) QuantizeLinear / DequantizeLinear pairs around the layers of an ONNX graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vlatool.errors import GraphError, require
from vlatool.graph.layers import Layer, Style
from vlatool.graph.qdq import QdqWriter, channel_peaks
from vlatool.runtime.interface import Array

FLOAT8_MAX = 448.0
"""Largest E4M3FN number: 1.75 x 2^8. The type has no infinity; larger values must be clipped, or they become NaN."""
MIN_OPSET, MIN_IR_VERSION = 19, 9
"""The first ONNX versions with float8."""


def to_float8(values: Array, axis: int | None, name: str) -> tuple[Array, Array]:
    """Round a weight to E4M3FN with ``scale = max|w| / 448``, to the nearest, ties to even, never beyond 448.

    Args:
        values: float32, any shape.
        axis: Axis with one scale for each entry; one scale for all when None.

    Returns:
        The codes as uint8 in the shape of ``values``, and float32 scales: () or (entries of the axis,).

    Raises:
        GraphError: when the weight holds NaN or infinity.
    """
    types = require("ml_dtypes", "build")
    largest, shape = channel_peaks(values, axis, name)
    scales = scale_of(largest)
    clipped = np.clip(values / scales.reshape(shape), -FLOAT8_MAX, FLOAT8_MAX)
    codes: Array = clipped.astype(types.float8_e4m3fn).view(np.uint8)
    return codes, scales


def scale_of(largest: Any) -> Array:
    """Return ``largest / 448`` as float32, 1 where there are only zeros, and never zero."""
    scales = np.where(np.asarray(largest) > 0, np.asarray(largest, np.float64) / FLOAT8_MAX, 1.0).astype(np.float32)
    return np.maximum(scales, np.finfo(np.float32).tiny)


class Float8Writer(QdqWriter):
    """Rewrites a graph so that chosen layers take float8 operands.

    Args:
        model: An ``onnx.ModelProto``, changed in place.
        layers: From ``find_layers`` of the same model.
        peaks: Value -> largest magnitude, of every activation of the layers.
        per_channel: One scale for each output channel of a weight.

    Raises:
        GraphError: when the opset has no float8.
    """

    codes = "float8"

    def __init__(self, model: Any, layers: Iterable[Layer], peaks: Mapping[str, float], per_channel: bool) -> None:
        super().__init__(
            model, layers, {name: (-peak, peak) for name, peak in peaks.items()}, Style(per_channel=per_channel)
        )
        if 0 < self.opset < MIN_OPSET:
            raise GraphError(
                f"The graph has opset {self.opset}; float8 needs opset {MIN_OPSET} or later.",
                "export it again: vlatool export SOURCE --opset 20",
            )
        model.ir_version = max(model.ir_version, MIN_IR_VERSION)

    def activation_scale(self, name: str) -> list[str]:
        """Add one scale, from the largest magnitude, and the zero point that sets the type; return their names."""
        return self.add_scale(name, scale_of(self.ranges[name][1]))

    def weight_codes(self, layer: Layer, min_scales: Array | None) -> tuple[str, Array, Array]:
        """Return the name of a quantized weight, its codes and its scales."""
        axis = layer.axis if self.style.per_channel else None
        name = layer.weight if axis is None else f"{layer.weight}.{axis}"
        return name, *to_float8(self.array(layer.weight), axis, layer.weight)

    def add_codes(self, name: str, codes: Array) -> str:
        """Add codes of a type that numpy lacks, as raw bytes."""
        kind, content = self.onnx.TensorProto.FLOAT8E4M3FN, np.ascontiguousarray(codes).tobytes()
        return self.add_tensor(self.onnx.helper.make_tensor(name, kind, codes.shape, content, raw=True))
