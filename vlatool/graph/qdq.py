"""Insert QuantizeLinear / DequantizeLinear pairs around the layers of an ONNX graph to compute them in 8 bits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError
from vlatool.graph.layers import Layer, Style, convolution_inputs, hoisted_values, signed_values
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.weights.pairs import LARGEST_SUM, largest_sums

Array = NDArray[Any]
Range = tuple[float, float]
ACTIVATION_TYPES = {"uint8": (0, 255, np.uint8), "int8": (-127, 127, np.int8), "int7": (-63, 63, np.int8)}
MAX_CODE = 127
"""Largest magnitude of an int8 weight."""
INT32 = float(2**31 - 1)
SMALLEST_NORMAL = np.finfo(np.float32).tiny


def insert_qdq(model: Any, layers: Iterable[Layer], ranges: Mapping[str, Range], style: Style) -> None:
    """Quantize layers to int8 in place.

    Args:
        model: An ``onnx.ModelProto``.
        layers: From ``find_layers`` of the same model.
        ranges: Value name -> (low, high), for every value of ``calibrated_values``.

    Raises:
        GraphError: when a weight holds NaN or infinity.
    """
    QdqWriter(model, layers, ranges, style).write()


class QdqWriter(OnnxGraph):
    """An ``onnx.ModelProto`` that is rebuilt in place, node by node, in int8; a subclass writes another type."""

    codes: ClassVar[str] = "int8"
    """Suffix of the names of stored codes."""

    def __init__(self, model: Any, layers: Iterable[Layer], ranges: Mapping[str, Range], style: Style) -> None:
        super().__init__(model)
        self.layers = {layer.name: layer for layer in layers}
        self.ranges, self.style = ranges, style
        chosen = self.layers.values()
        self.hoisted = hoisted_values(model, chosen, style)
        self.convolution_inputs = convolution_inputs(chosen, style, self.hoisted)
        self.signed = signed_values(chosen, style)
        convolutions = {layer.output for layer in chosen if layer.kind == "Conv" and style.fused_convolutions}
        self.fused = convolutions - self.outputs
        self.nodes: list[Any] = []
        self.dequantized: dict[Any, str] = {}

    def write(self) -> None:
        """Rebuild the list of nodes, with each pair before its first reader."""
        hoisted: dict[str, str] = {}
        rerouted: dict[str, str] = {}
        roots, movers = set(self.hoisted.values()), self._movers()
        hoisted.update({value.name: self.activation(value.name) for value in self.graph.input if value.name in roots})
        for node in self.graph.node:
            for index, name in enumerate(node.input):
                node.input[index] = rerouted.get(name, name)
                if node.name in movers:
                    node.input[index] = hoisted.get(name, node.input[index])
            if node.name in self.layers:
                self._quantize(node, self.layers[node.name])
            self.nodes.append(node)
            hoisted.update({name: self.activation(name) for name in node.output if name in roots})
            if node.output[0] in self.fused:
                rerouted[node.output[0]] = self.activation(node.output[0])
        self.replace_nodes(self.nodes)
        self.drop_unread_constants()
        del self.graph.value_info[:]

    def _movers(self) -> set[str]:
        """Return the nodes between hoisted quantizers and the layers; other readers keep their float values."""
        movers: set[str] = set()
        for name, root in self.hoisted.items():
            while name != root:
                movers.add(self.producers[name].name)
                name = self.producers[name].input[0]
        return movers

    def _quantize(self, node: Any, layer: Layer) -> None:
        for index, name in enumerate(node.input):
            if name in layer.activations and name not in self.hoisted:
                node.input[index] = self.activation(name)
        if not layer.weight:
            return
        biased = self.style.fused_convolutions and layer.bias in self.constants
        name, codes, scales = self.weight_codes(layer, self._min_scales(layer) if biased else None)
        key = (name, scales.tobytes())
        if key not in self.dequantized:
            if f"{name}.{self.codes}" in self.constants:  # a convolution with the same weight, but other scales
                name = f"{name}.{layer.name}"
            stored = self.add_codes(f"{name}.{self.codes}", codes)
            axis = {"axis": layer.axis} if scales.ndim else {}
            self.dequantized[key] = self._dequantize(name, [stored, *self.add_scale(name, scales)], **axis)
        node.input[1] = self.dequantized[key]
        if biased:
            node.input[2] = self._bias(layer, scales)

    def activation(self, name: str) -> str:
        """Return the dequantized counterpart of a value, created at its first use."""
        if name not in self.dequantized:
            scale = self.activation_scale(name)
            self.nodes.append(self.node("QuantizeLinear", [name, *scale], [f"{name}.q"], f"{name}/quantize"))
            self.dequantized[name] = self._dequantize(name, [self._clip_to_7_bits(name), *scale])
        return self.dequantized[name]

    def _clip_to_7_bits(self, name: str) -> str:
        """Return the quantized value, clipped to 7 bits even where an observation leaves the calibrated range."""
        quantized = f"{name}.q"
        if name not in self.signed or not self.style.reduce_range:
            return quantized
        lowest, highest, dtype = ACTIVATION_TYPES["int7"]
        bounds = [self.add(f"{quantized}.{side}", np.array(value, dtype))
                  for side, value in (("lowest", lowest), ("highest", highest))]  # fmt: skip
        self.nodes.append(self.node("Clip", [quantized, *bounds], [f"{quantized}7"], f"{name}/bound"))
        return f"{quantized}7"

    def _dequantize(self, name: str, inputs: list[str], **axis: int) -> str:
        self.nodes.append(self.node("DequantizeLinear", inputs, [f"{name}.dq"], f"{name}/dequantize", **axis))
        return f"{name}.dq"

    def activation_scale(self, name: str) -> list[str]:
        """Add the scale and the zero point of an activation; return their names."""
        low, high = self.ranges[name]
        kind: str = self.style.activations
        if kind == "symmetric":
            kind = "uint8" if low >= 0 else "int8"
        if name in self.convolution_inputs:
            kind = "uint8"
        if name in self.signed:
            kind = "int7"
        if kind != "uint8":  # its zero point is 0, so a one-sided range would lose half of the codes
            low, high = -max(-low, high), max(-low, high)
        lowest, highest, dtype = ACTIVATION_TYPES[kind]
        scale = (high - low) / (highest - lowest) if high > low else 1.0
        scale = float(np.float32(scale)) or 1.0
        zero = 0 if kind != "uint8" else int(np.clip(round(-low / scale), lowest, highest))
        return [self.add(f"{name}.scale", scale, np.float32), self.add(f"{name}.zero", zero, dtype)]

    def weight_codes(self, layer: Layer, min_scales: Array | None) -> tuple[str, Array, Array]:
        """Return the name of a quantized weight, its codes, and its scales: one, or one for each entry of the axis."""
        values = self.array(layer.weight)
        axis = layer.axis if self.style.per_channel and 2 <= values.ndim <= 5 else None
        sums = largest_sums(values, layer.kind, layer.axis) if self.style.reduce_range else None
        return f"{layer.weight}.{layer.axis}", *quantize_weight(values, axis, layer.weight, min_scales, sums)

    def add_codes(self, name: str, codes: Array) -> str:
        """Add a constant of the type of weights; return its name."""
        return self.add(name, codes)

    def add_scale(self, name: str, scales: Array) -> list[str]:
        """Add scales and zero points of 0; return their names."""
        return [self.add(f"{name}.scale", scales), self.add_codes(f"{name}.zero", np.zeros(scales.shape, np.int8))]

    def _bias(self, layer: Layer, scales: Array) -> str:
        """Return the dequantized counterpart of a bias: int32 with the scale of the products."""
        values = self.array(layer.bias)
        step = np.broadcast_to((scales * self._input_scale(layer)).astype(np.float32), values.shape)
        step = np.maximum(step, SMALLEST_NORMAL)
        quantized = np.clip(np.rint(values.astype(np.float64) / step), -INT32, INT32).astype(np.int32)
        name = f"{layer.bias}.{layer.name}"
        zero = np.zeros(step.shape, np.int32)
        inputs = [self.add(f"{name}.int32", quantized), self.add(f"{name}.scale", step), self.add(f"{name}.zero", zero)]
        return self._dequantize(name, inputs, axis=0)

    def _min_scales(self, layer: Layer) -> Array:
        """Return the smallest scale of each channel's weights with which its bias still fits into int32.

        A bias has the scale of weight times activation. A channel with almost zero weights (a dead one with a folded
        normalisation) would push its bias out of int32, and the bias is the whole output of such a channel.
        """
        bias = np.abs(self.array(layer.bias).astype(np.float64))
        least = np.minimum(bias / (float(self._input_scale(layer)) * INT32 / 2), np.finfo(np.float32).max)
        return least.astype(np.float32)

    def _input_scale(self, layer: Layer) -> Array:
        """Return the scale of the input of a layer, float32 ()."""
        return self.array(f"{layer.activations[0]}.scale")


def quantize_weight(
    values: Array, axis: int | None, name: str, min_scales: Array | None = None, sums: Array | None = None
) -> tuple[Array, Array]:
    """Quantize a weight symmetrically to int8.

    Args:
        values: float32, any shape.
        axis: Axis with one scale for each entry; one scale for all when None.
        min_scales: Smallest allowed scales, one for each entry of the axis.
        sums: Largest magnitudes of a sum of two paired weights, one for each output, where such a sum must fit into
            int8, too (``weights.pairs``).

    Returns:
        int8 of the same shape, and float32 scales: () or (entries of the axis,).

    Raises:
        GraphError: when the weight holds NaN or infinity.
    """
    largest, shape = channel_peaks(values, axis, name)
    scales = np.where(largest > 0, largest / MAX_CODE, 1.0).astype(np.float32)
    if sums is not None:
        scales = np.maximum(scales, (sums if axis is not None else sums.max(initial=0.0)) / LARGEST_SUM)
    scales = np.where(scales > 0, scales, SMALLEST_NORMAL).astype(np.float32)
    if min_scales is not None:
        lowest = min_scales if axis is not None else min_scales.max(initial=0.0)
        scales = np.where((largest == 0) & (lowest > 0), lowest, np.maximum(scales, lowest)).astype(np.float32)
    return np.clip(np.rint(values / scales.reshape(shape)), -MAX_CODE, MAX_CODE).astype(np.int8), scales


def channel_peaks(values: Array, axis: int | None, name: str) -> tuple[Array, list[int]]:
    """Return the largest magnitude for each entry of an axis, or of all, and the shape that broadcasts it.

    Raises:
        GraphError: when the weight of that name holds NaN or infinity.
    """
    if not np.isfinite(values).all():
        raise GraphError(f"The weight '{name}' holds NaN or infinity.", "look at the checkpoint")
    others = None if axis is None else tuple(index for index in range(values.ndim) if index != axis)
    largest: Array = np.abs(values).max(axis=others) if values.size else np.zeros((), np.float32)
    return largest, [-1 if index == axis else 1 for index in range(values.ndim)]
