"""Put QuantizeLinear / DequantizeLinear pairs around the layers of an ONNX graph that shall be computed in int8."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError, require
from vlatool.graph.layers import (
    Layer,
    Style,
    convolved,
    hoisted,
    signed,
)
from vlatool.graph.nodes import read_names

Range = tuple[float, float]
ACTIVATION = {"uint8": (0, 255, np.uint8), "int8": (-127, 127, np.int8), "int7": (-63, 63, np.int8)}
INT32 = float(2**31 - 1)


def insert_qdq(model: Any, layers: Iterable[Layer], ranges: Mapping[str, Range], style: Style) -> None:
    """Quantize layers in place.

    Args:
        model: An ``onnx.ModelProto``.
        layers: From ``find_layers`` of the same model.
        ranges: Value name -> (low, high), of every value that ``wanted_values`` names.
        style: How they are written.

    Raises:
        GraphError: when a weight holds NaN or infinity.
    """
    chosen = list(layers)
    moved = hoisted(model, chosen, style)
    _Writer(model, {layer.name: layer for layer in chosen}, ranges, style, moved).write()
    del model.graph.value_info[:]


@dataclass
class _Writer:
    model: Any
    layers: Mapping[str, Layer]
    ranges: Mapping[str, Range]
    style: Style
    moved: Mapping[str, str]
    nodes: list[Any] = field(default_factory=list)
    made: dict[Any, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.onnx = require("onnx", "build")
        self.graph = self.model.graph
        self.constants = {tensor.name: tensor for tensor in self.graph.initializer}
        self.outputs = {value.name for value in self.graph.output}
        self.convolved = convolved(self.layers.values(), self.style, self.moved)
        self.signed = signed(self.layers.values(), self.style)

    def write(self) -> None:
        """Rebuild the list of nodes with the pairs before their first reader."""
        rerouted: dict[str, str] = {}
        hoisted_to: dict[str, str] = {}
        roots, movers = set(self.moved.values()), self._movers()
        for name in (value.name for value in self.graph.input if value.name in roots):
            hoisted_to[name] = self._activation(name)
        for node in list(self.graph.node):
            for index, name in enumerate(node.input):
                node.input[index] = rerouted.get(name, name)
                if node.name in movers:
                    node.input[index] = hoisted_to.get(name, node.input[index])
            layer = self.layers.get(node.name)
            if layer is not None:
                self._quantize(node, layer)
            self.nodes.append(node)
            for name in (name for name in node.output if name in roots):
                hoisted_to[name] = self._activation(name)
            conv = self._fused_by(node)
            if conv is not None:
                rerouted[conv.output] = self._activation(conv.output)
        del self.graph.node[:]
        self.graph.node.extend(self.nodes)
        used = read_names(self.nodes) | self.outputs
        kept = [tensor for tensor in self.graph.initializer if tensor.name in used]
        del self.graph.initializer[:]
        self.graph.initializer.extend(kept)

    def _movers(self) -> set[str]:
        """Return the nodes between what is quantized early and the layers; other readers keep their float values."""
        producers = {name: node for node in self.graph.node for name in node.output}
        found: set[str] = set()
        for name, root in self.moved.items():
            while name != root:
                found.add(producers[name].name)
                name = producers[name].input[0]
        return found

    def _fused_by(self, node: Any) -> Layer | None:
        """Return the convolution whose output this node gives, when outputs are quantized."""
        if not self.style.fused_convolutions:
            return None
        for layer in self.layers.values():
            if layer.kind == "Conv" and layer.output == node.output[0] and layer.output not in self.outputs:
                return layer
        return None

    def _quantize(self, node: Any, layer: Layer) -> None:
        for index, name in enumerate(node.input):
            if name in layer.activations and name not in self.moved:
                node.input[index] = self._activation(name)
        if not layer.weight:
            return
        biased = bool(layer.bias) and self.style.fused_convolutions and layer.bias in self.constants
        weight, scales = self._weight(layer, self._least_scales(layer) if biased else None)
        node.input[1] = weight
        if biased:
            node.input[2] = self._bias(layer, scales)

    def _activation(self, name: str) -> str:
        """Return the dequantized twin of a value, made at its first use."""
        if name in self.made:
            return self.made[name]
        low, high = self.ranges[name]
        kind: str = self.style.activations
        if kind == "symmetric":
            kind = "uint8" if low >= 0 else "int8"
        if name in self.convolved:
            kind = "uint8"
        if name in self.signed:
            kind = "int7"
        if kind != "uint8":  # its zero point is 0, so that a range to one side would lose half of it
            low, high = -max(-low, high), max(-low, high)
        lowest, highest, dtype = ACTIVATION[kind]
        scale = (high - low) / (highest - lowest) if high > low else 1.0
        scale = float(np.float32(scale)) or 1.0
        zero = 0 if kind != "uint8" else int(np.clip(round(-low / scale), lowest, highest))
        parts = [
            self._constant(f"{name}.scale", np.array(scale, np.float32)),
            self._constant(f"{name}.zero", np.array(zero, dtype)),
        ]
        made = self.onnx.helper.make_node
        self.nodes.append(made("QuantizeLinear", [name, *parts], [f"{name}.q"], name=f"{name}/quantize"))
        self.nodes.append(made("DequantizeLinear", [f"{name}.q", *parts], [f"{name}.dq"], name=f"{name}/dequantize"))
        self.made[name] = f"{name}.dq"
        return self.made[name]

    def _weight(self, layer: Layer, least: NDArray[np.float32] | None) -> tuple[str, NDArray[np.float32]]:
        """Return the dequantized twin of a weight and its scales (one, or one for each entry of the axis)."""
        values = self.onnx.numpy_helper.to_array(self.constants[layer.weight])
        quantized, scales = quantize_weight(values, layer.axis if self._channels(values) else None,
                                            63 if self.style.reduce_range else 127, layer.weight, least)  # fmt: skip
        key = (layer.weight, layer.axis, scales.tobytes())
        if key in self.made:
            return self.made[key], scales
        name = f"{layer.weight}.{layer.axis}"
        if f"{name}.int8" in self.constants:  # a convolution with the same weight, but other scales for its bias
            name = f"{name}.{layer.name}"
        inputs = [
            self._constant(f"{name}.int8", quantized),
            self._constant(f"{name}.scale", scales),
            self._constant(f"{name}.zero", np.zeros(scales.shape, np.int8)),
        ]
        axis = {"axis": layer.axis} if scales.ndim else {}
        self.nodes.append(
            self.onnx.helper.make_node("DequantizeLinear", inputs, [f"{name}.dq"], name=f"{name}/dequantize", **axis)
        )
        self.made[key] = f"{name}.dq"
        return self.made[key], scales

    def _channels(self, values: NDArray[Any]) -> bool:
        return self.style.per_channel and (values.ndim == 2 or values.ndim in (3, 4, 5))

    def _bias(self, layer: Layer, scales: NDArray[np.float32]) -> str:
        """Return the dequantized twin of a bias: int32 with the scale of the products."""
        key = (layer.bias, layer.name)
        values = self.onnx.numpy_helper.to_array(self.constants[layer.bias])
        step = self.onnx.numpy_helper.to_array(self._tensor(f"{layer.activations[0]}.scale"))
        product = np.broadcast_to((scales * step).astype(np.float32), values.shape).copy()
        product = np.maximum(product, np.finfo(np.float32).tiny)
        quantized = np.clip(np.rint(values.astype(np.float64) / product), -INT32, INT32).astype(np.int32)
        name = f"{layer.bias}.{layer.name}"
        inputs = [
            self._constant(f"{name}.int32", quantized),
            self._constant(f"{name}.scale", product),
            self._constant(f"{name}.zero", np.zeros(product.shape, np.int32)),
        ]
        self.nodes.append(
            self.onnx.helper.make_node("DequantizeLinear", inputs, [f"{name}.dq"], name=f"{name}/dequantize", axis=0)
        )
        self.made[key] = f"{name}.dq"
        return self.made[key]

    def _least_scales(self, layer: Layer) -> NDArray[np.float32]:
        """Return the smallest scale of each channel's weights with which its bias still fits into int32.

        A bias has the scale of weight times activation. A channel with next to no weights (a dead one whose
        normalisation was folded in) would push its bias out of int32, and the bias is all that such a channel gives.
        """
        bias = np.abs(self.onnx.numpy_helper.to_array(self.constants[layer.bias]).astype(np.float64))
        step = float(self.onnx.numpy_helper.to_array(self._tensor(f"{layer.activations[0]}.scale")))
        least: NDArray[np.float32] = np.minimum(bias / (step * INT32 / 2), np.finfo(np.float32).max).astype(np.float32)
        return least

    def _constant(self, name: str, values: NDArray[Any]) -> str:
        if name not in self.constants:
            tensor = self.onnx.numpy_helper.from_array(values, name)
            self.constants[name] = tensor
            self.graph.initializer.append(tensor)
        return name

    def _tensor(self, name: str) -> Any:
        return self.constants[name]


def quantize_weight(
    values: NDArray[Any], axis: int | None, highest: int, name: str, least: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Quantize a weight symmetrically to int8.

    Args:
        values: float32, any shape.
        axis: Axis with one scale for each entry; one scale for all when None.
        highest: Largest magnitude, 127 or 63.
        name: For messages.
        least: Smallest scales that are allowed, one for each entry of the axis.

    Returns:
        int8 of the same shape, and float32 scales: () or (entries of the axis,).

    Raises:
        GraphError: when the weight holds NaN or infinity.
    """
    if not np.isfinite(values).all():
        raise GraphError(f"The weight '{name}' holds NaN or infinity.", "look at the checkpoint")
    others = tuple(index for index in range(values.ndim) if index != axis) if axis is not None else None
    largest = np.abs(values).max(axis=others) if values.size else np.zeros((), np.float32)
    scales = np.where(largest > 0, largest / highest, 1.0).astype(np.float32)
    scales = np.where(scales > 0, scales, np.finfo(np.float32).tiny).astype(np.float32)
    if least is not None:
        lowest = least if axis is not None else least.max(initial=0.0)
        scales = np.where((largest == 0) & (lowest > 0), lowest, np.maximum(scales, lowest)).astype(np.float32)
    shape = [1] * values.ndim
    if axis is not None:
        shape[axis] = -1
    quantized = np.clip(np.rint(values / scales.reshape(shape)), -highest, highest).astype(np.int8)
    return quantized, scales
