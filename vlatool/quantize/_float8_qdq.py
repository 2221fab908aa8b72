"""Put float8 (E4M3) QuantizeLinear / DequantizeLinear pairs around the layers of an ONNX graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError, require
from vlatool.graph.layers import Layer
from vlatool.graph.nodes import read_names

Array = NDArray[Any]

LARGEST = 448.0
"""Largest E4M3FN number: 1.75 x 2^8. There is no infinity; what is larger must be clipped, or it becomes NaN."""
OPSET, IR_VERSION = 19, 9
"""The first ONNX versions with float8."""


def to_float8(values: Array, axis: int | None, name: str) -> tuple[Array, Array]:
    """Round a weight to E4M3FN with ``scale = max|w| / 448``, to the nearest, ties to even, never beyond 448.

    Args:
        values: float32, any shape.
        axis: Axis with one scale for each entry; one scale for all when None.
        name: For messages.

    Returns:
        The codes as uint8 in the shape of ``values``, and float32 scales: () or (entries of the axis,).

    Raises:
        GraphError: when the weight holds NaN or infinity.
    """
    types = require("ml_dtypes", "build")
    if not np.isfinite(values).all():
        raise GraphError(f"The weight '{name}' holds NaN or infinity.", "look at the checkpoint")
    others = None if axis is None else tuple(index for index in range(values.ndim) if index != axis)
    largest = np.abs(values).max(axis=others) if values.size else np.zeros((), np.float32)
    scales = scale_of(largest)
    shape = [1] * values.ndim
    if axis is not None:
        shape[axis] = -1
    clipped = np.clip(values / scales.reshape(shape), -LARGEST, LARGEST)
    codes: Array = clipped.astype(types.float8_e4m3fn).view(np.uint8)
    return codes, scales


def scale_of(largest: Any) -> Array:
    """Return ``largest / 448`` as float32, 1 where there are only zeros, and never zero."""
    scales = np.where(np.asarray(largest) > 0, np.asarray(largest, np.float64) / LARGEST, 1.0).astype(np.float32)
    return np.maximum(scales, np.finfo(np.float32).tiny)


class Float8Writer:
    """Rewrites a graph so that chosen layers take float8 operands.

    Args:
        model: An ``onnx.ModelProto``, changed in place.
        layers: From ``find_layers`` of the same model.
        peaks: Value -> largest magnitude, of every activation of the layers.
        per_channel: One scale for each output channel of a weight.

    Raises:
        GraphError: when the opset has no float8.
    """

    def __init__(self, model: Any, layers: Iterable[Layer], peaks: Mapping[str, float], per_channel: bool) -> None:
        self._onnx = require("onnx", "build")
        self._model, self._graph = model, model.graph
        self._layers = {layer.name: layer for layer in layers}
        self._peaks, self._per_channel = peaks, per_channel
        self._constants = {tensor.name: tensor for tensor in model.graph.initializer}
        self._made: dict[tuple[str, int | None], str] = {}
        self._nodes: list[Any] = []
        for entry in model.opset_import:
            if entry.domain in ("", "ai.onnx") and entry.version < OPSET:
                raise GraphError(
                    f"The graph has opset {entry.version}; float8 needs opset {OPSET} or later.",
                    "export it again: vlatool export SOURCE --opset 20",
                )

    def write(self) -> None:
        """Quantize the layers."""
        for node in list(self._graph.node):
            layer = self._layers.get(node.name)
            if layer is not None:
                for place, name in enumerate(node.input):
                    if name in layer.activations:
                        node.input[place] = self._activation(name)
                    elif name == layer.weight:
                        node.input[place] = self._weight(layer)
            self._nodes.append(node)
        del self._graph.node[:]
        self._graph.node.extend(self._nodes)
        used = read_names(self._nodes) | {value.name for value in self._graph.output}
        for index in range(len(self._graph.initializer) - 1, -1, -1):
            if self._graph.initializer[index].name not in used:
                del self._graph.initializer[index]
        self._model.ir_version = max(self._model.ir_version, IR_VERSION)
        del self._graph.value_info[:]

    def _activation(self, name: str) -> str:
        """Return the dequantized twin of a value: one scale, from its largest magnitude."""
        key = (name, None)
        if key not in self._made:
            parts = self._scale(name, scale_of(self._peaks[name]))
            self._add("QuantizeLinear", [name, *parts], f"{name}.q", f"{name}/quantize")
            self._made[key] = self._add("DequantizeLinear", [f"{name}.q", *parts], f"{name}.dq", f"{name}/dequantize")
        return self._made[key]

    def _weight(self, layer: Layer) -> str:
        """Return the dequantized twin of a weight, whose codes are stored."""
        axis = layer.axis if self._per_channel else None
        key = (layer.weight, axis)
        if key not in self._made:
            values = self._onnx.numpy_helper.to_array(self._constants[layer.weight])
            codes, scales = to_float8(values, axis, layer.weight)
            name = layer.weight if axis is None else f"{layer.weight}.{axis}"
            inputs = [self._float8(f"{name}.float8", codes), *self._scale(name, scales)]
            along = {} if axis is None else {"axis": axis}
            self._made[key] = self._add("DequantizeLinear", inputs, f"{name}.dq", f"{name}/dequantize", **along)
        return self._made[key]

    def _scale(self, name: str, scales: Array) -> list[str]:
        """Write scales and the zero points that say the type; return their names."""
        self._graph.initializer.append(self._onnx.numpy_helper.from_array(scales, f"{name}.scale"))
        return [f"{name}.scale", self._float8(f"{name}.zero", np.zeros(scales.shape, np.uint8))]

    def _float8(self, name: str, codes: Array) -> str:
        kind = self._onnx.TensorProto.FLOAT8E4M3FN
        content = np.ascontiguousarray(codes).tobytes()
        self._graph.initializer.append(self._onnx.helper.make_tensor(name, kind, codes.shape, content, raw=True))
        return name

    def _add(self, kind: str, inputs: list[str], output: str, name: str, **attributes: Any) -> str:
        self._nodes.append(self._onnx.helper.make_node(kind, inputs, [output], name=name, **attributes))
        return output
