"""What the tests of quantization pairs share: graphs as text, ONNX Runtime without optimizations, numpy references."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import onnx.parser
import onnxruntime
from onnx import numpy_helper

from vlatool.graph.layers import Layer, Style, calibrated_values, find_layers, hoisted_values
from vlatool.graph.nodes import name_nodes
from vlatool.graph.qdq import insert_qdq

Array = np.ndarray[Any, Any]
OPS = ("MatMul", "Gemm", "Conv")
STYLES = {
    "uint8": Style(),
    "int8": Style("int8"),
    "symmetric": Style("symmetric", unsigned_convolutions=True),
    "int8 but for convolutions": Style("int8", unsigned_convolutions=True),
    "per tensor": Style(per_channel=False),
    "no pair saturates": Style(reduce_range=True),
    "fused": Style(fused_convolutions=True),
    "hoist": Style("symmetric", hoist=True, unsigned_convolutions=True),
}


def weight(*shape: int, seed: int = 0, scale: float = 1.0) -> Array:
    return (np.random.default_rng(seed).standard_normal(shape) * scale).astype(np.float32)


def graph(text: str, opset: int = 20, **weights: Array) -> Any:
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : {opset}]> g {text}')
    model.graph.initializer.extend(numpy_helper.from_array(values, name) for name, values in weights.items())
    name_nodes(model)
    return model


def run(model: Any, **feeds: Array) -> dict[str, Array]:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds), strict=True))


def quantized(
    model: Any, style: Style, ranges: dict[str, tuple[float, float]], **options: bool
) -> tuple[Any, list[Layer]]:
    layers = find_layers(model, OPS, **options)
    wanted = calibrated_values(layers, style, hoisted_values(model, layers, style))
    insert_qdq(model, layers, {name: ranges.get(name, (-3.0, 3.0)) for name in wanted}, style)
    onnx.checker.check_model(model, full_check=True)
    return model, layers


def rounded(values: Array, style: Style, low: float = -3.0, high: float = 3.0, convolved: bool = False) -> Array:
    """Reference: an activation after quantization; ``convolved`` when a convolution reads it."""
    kind = style.activations
    if kind == "symmetric":
        kind = "uint8" if low >= 0 else "int8"
    if convolved and style.unsigned_convolutions:
        kind = "uint8"
    if kind == "int8":
        low, high = -max(-low, high), max(-low, high)
    first, last = (0, 255) if kind == "uint8" else (-127, 127)
    scale = np.float32((high - low) / (last - first))
    zero = 0 if kind == "int8" else round(-low / float(scale))
    lowest = -128 if kind == "int8" else 0
    codes = np.clip(np.rint(values / scale) + zero, lowest, 127 if kind == "int8" else 255)
    return ((codes - zero) * scale).astype(np.float32)


def rounded_weight(values: Array, style: Style, axis: int) -> Array:
    """Reference: a weight after quantization."""
    others = tuple(index for index in range(values.ndim) if index != axis) if style.per_channel else None
    scale = np.abs(values).max(axis=others, keepdims=True).astype(np.float32) / np.float32(127)
    if style.reduce_range:
        scale = np.maximum(scale, largest_pair(values, axis).reshape(scale.shape) / np.float32(126))
    return (np.clip(np.rint(values / scale), -127, 127) * scale).astype(np.float32)


def largest_pair(values: Array, axis: int) -> Array:
    """Reference: for each output, the largest magnitude of a sum of two weights that an engine adds up in one step."""
    found = []
    for weights in np.moveaxis(values, axis, 0):
        summed = weights.transpose(1, 2, 0) if weights.ndim == 3 else weights
        orders = [summed.ravel()]
        if weights.ndim == 3 and len(weights) % 2:
            orders.append(np.pad(summed, ((0, 0), (0, 0), (0, 1))).ravel())
        found.append(max(abs(row[at] + row[at + 1]) for row in orders for at in range(0, len(row) - 1, 2)))
    return np.array(found, np.float32)


def kinds(model: Any) -> dict[str, int]:
    found = [node.op_type for node in model.graph.node]
    return {kind: found.count(kind) for kind in found}


def close(got: Array, wanted: Array) -> None:
    np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4 * float(np.abs(wanted).max()))


def conv(x: Array, w: Array) -> Array:
    """A convolution with a stride of the kernel's size."""
    size = w.shape[-1]
    blocks = x.reshape(x.shape[0], x.shape[1], x.shape[2] // size, size, x.shape[3] // size, size)
    return np.asarray(np.einsum("ncihjw,ochw->noij", blocks, w, optimize=True))


X, IMAGE = weight(4, 6, seed=9), weight(1, 3, 8, 8, seed=8)
