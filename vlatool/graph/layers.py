"""The layers of an ONNX graph that can be computed in int8, and the values that they read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from vlatool.errors import GraphError, require
from vlatool.graph.nodes import reads, varying
from vlatool.graph.shapes import nodes_inside
from vlatool.graph.types import FLOAT, float_names

LOWEST_OPSET = 13
"""Per-channel scales came with opset 13."""
SHAPES = ("Reshape", "Transpose", "Unsqueeze", "Squeeze", "Flatten", "Split", "Slice", "MaxPool")
"""Operators that only move values: what is quantized before them stays quantized."""
FOLLOWS = ("Relu", "Clip")
"""Activation functions that engines fuse into the quantization of a convolution's output."""


@dataclass(frozen=True)
class Layer:
    """A node that can be computed in int8.

    Args:
        name: Name of the node.
        kind: Operator type.
        activations: Values that must be quantized at run time.
        weight: Initializer that is quantized ahead of time; empty when both operands are activations.
        axis: Axis of the weight with one scale for each entry.
        bias: Initializer that is added, for convolutions.
        output: What the node gives, after a Relu or Clip that engines fuse.
    """

    name: str
    kind: str
    activations: tuple[str, ...]
    weight: str = ""
    axis: int = 0
    bias: str = ""
    output: str = ""


@dataclass(frozen=True)
class Style:
    """How layers are written.

    Args:
        activations: ``uint8`` with a zero point, ``int8`` symmetric, or ``symmetric``: int8, and uint8 with the zero
            point 0 for what is never negative.
        per_channel: One weight scale for each output channel.
        reduce_range: 7-bit weights.
        fused_convolutions: Quantize a convolution's bias and output too: ONNX Runtime then computes it in int8.
        hoist: Quantize before operators that only move values, so that they move bytes instead of floats.
        signed_second: Write the second of two activations that are multiplied (keys and values of attention) in 7 bits
            and signed, whatever the others are: ONNX Runtime multiplies uint8 with int8 twice as fast as with uint8 on
            x86, and within 63 no processor saturates.
        unsigned_convolutions: Write what convolutions read as uint8 with a zero point, whatever the others are.
    """

    activations: Literal["uint8", "int8", "symmetric"] = "uint8"
    per_channel: bool = True
    reduce_range: bool = False
    fused_convolutions: bool = False
    hoist: bool = False
    signed_second: bool = False
    unsigned_convolutions: bool = False


def find_layers(model: Any, ops: Iterable[str], *, attention: bool = False, elementwise: bool = False) -> list[Layer]:
    """Return the layers of a graph that can be computed in int8, in the order of the graph.

    What depends on no input stays as it is: engines compute it once, and OpenVINO (2026.4) fails on a graph in which
    such a value is quantized, or computes it wrongly.

    Args:
        model: An ``onnx.ModelProto``.
        ops: ``MatMul``, ``Gemm``, ``Conv``: operators with constant weights that are wanted.
        attention: Also products of two activations.
        elementwise: Also sums of two activations (residual connections).

    Raises:
        GraphError: when the opset is too old.
    """
    for entry in model.opset_import:
        if entry.domain in ("", "ai.onnx") and entry.version < LOWEST_OPSET:
            raise GraphError(f"The graph has opset {entry.version}; int8 needs opset {LOWEST_OPSET} or later.")
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    floats = float_names(model) if elementwise else set()
    readers, live = _readers(model), varying(model)
    found = []
    for node in model.graph.node:
        if node.op_type in ops or (node.op_type == "MatMul" and attention):
            layer = _weighted(node, constants, node.op_type in ops, attention)
        elif node.op_type == "Add" and elementwise:
            both = all(name in floats and name not in constants for name in node.input)
            layer = Layer(node.name, "Add", tuple(node.input)) if both else None
        else:
            layer = None
        if layer is not None and live.issuperset(layer.activations):
            found.append(_with_output(layer, node, readers))
    return found


def check_weights(model: Any, layers: Iterable[Layer]) -> None:
    """Look at the weights and biases of layers before anything is computed with them.

    Raises:
        GraphError: when one holds NaN or infinity; names it and its layer.
    """
    onnx = require("onnx", "build")
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes = {node.name: node for node in model.graph.node}
    for layer in layers:
        for name in nodes[layer.name].input:
            if name in constants and constants[name].data_type == FLOAT:
                values = onnx.numpy_helper.to_array(constants[name])
                bad = int(values.size - np.isfinite(values).sum())
                if bad:
                    raise GraphError(
                        f"The weight '{name}' of the layer '{layer.name}' holds NaN or infinity ({bad} of "
                        f"{values.size} values); allowed: finite ones.",
                        "look at the checkpoint, or leave the layer in float32 with --exclude",
                    )


def _weighted(node: Any, constants: Mapping[str, Any], weighted: bool, attention: bool) -> Layer | None:
    attributes = {item.name: item.i for item in node.attribute}
    weight = constants.get(node.input[1])
    if weight is None or weight.data_type != FLOAT or len(weight.dims) < 2:
        plain = node.op_type == "MatMul" and attention and weight is None and node.input[0] not in constants
        return Layer(node.name, "MatMul", tuple(node.input)) if plain else None
    if not weighted or node.input[0] in constants or attributes.get("transA"):
        return None
    axis = len(weight.dims) - 1
    if node.op_type == "Conv" or (node.op_type == "Gemm" and attributes.get("transB")):
        axis = 0
    bias = node.input[2] if node.op_type == "Conv" and len(node.input) > 2 else ""
    return Layer(node.name, node.op_type, (node.input[0],), node.input[1], axis, bias)


def _with_output(layer: Layer, node: Any, readers: Mapping[str, list[Any]]) -> Layer:
    output = node.output[0]
    after = readers.get(output, [])
    if len(after) == 1 and after[0].op_type in FOLLOWS:
        output = after[0].output[0]
    return Layer(layer.name, layer.kind, layer.activations, layer.weight, layer.axis, layer.bias, output)


def hoisted(model: Any, layers: Iterable[Layer], style: Style) -> dict[str, str]:
    """Return value that a layer reads -> the value that is quantized in its place, where they differ.

    A value moves up through an operator of ``SHAPES`` when all that read it are quantized layers and the graph does not
    give it; through Split always, whose other parts are then rounded too.
    """
    if not style.hoist:
        return {}
    wanted = {(layer.name, name) for layer in layers for name in layer.activations}
    producers = {name: node for node in model.graph.node for name in node.output}
    readers = _readers(model)
    constants = {tensor.name for tensor in model.graph.initializer}
    outputs = {value.name for value in model.graph.output}
    found: dict[str, str] = {}
    for name in sorted({name for _, name in wanted}):
        value, moved = name, False
        while True:
            before = producers.get(value)
            if before is None or before.op_type not in SHAPES or before.input[0] in constants or value in outputs:
                break
            whole = all((reader.name, value) in wanted for reader in readers[value]) if not moved else (
                len(readers[value]) == 1)  # fmt: skip
            if not whole:
                break
            value, moved = before.input[0], True
        if moved:
            found[name] = value
    return found


def wanted_values(layers: Iterable[Layer], style: Style, moved: Mapping[str, str]) -> list[str]:
    """Return the values whose ranges are needed, each once, in order."""
    found: dict[str, None] = {}
    for layer in layers:
        found.update(dict.fromkeys(moved.get(name, name) for name in layer.activations))
        if style.fused_convolutions and layer.kind == "Conv":
            found[layer.output] = None
    return list(found)


def convolved(layers: Iterable[Layer], style: Style, moved: Mapping[str, str]) -> set[str]:
    """Return the values that are written as uint8 because a convolution reads them.

    On x86 processors without AMX, OpenVINO (2025.2 to 2026.4) turns signed inputs of convolutions into unsigned ones,
    and loses their scale where a Concat is near; unsigned ones it computes as they are written, everywhere.
    """
    if not style.unsigned_convolutions:
        return set()
    return {moved.get(name, name) for layer in layers if layer.kind == "Conv" for name in layer.activations}


def signed(layers: Iterable[Layer], style: Style) -> set[str]:
    """Return the values that are written in 7 bits and signed; what is also read as a first operand is not."""
    products = [layer for layer in layers if layer.kind == "MatMul" and not layer.weight]
    if not style.signed_second:
        return set()
    return {layer.activations[1] for layer in products} - {layer.activations[0] for layer in layers}


def split_gemm(model: Any) -> int:
    """Rewrite every plain Gemm with a constant weight as MatMul and Add, in place; return how many.

    ONNX Runtime has an integer MatMul with float output, but none for Gemm.
    """
    onnx = require("onnx", "build")
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes, count = [], 0
    for node in model.graph.node:
        attributes = {item.name: onnx.helper.get_attribute_value(item) for item in node.attribute}
        plain = attributes.get("alpha", 1.0) == 1.0 and attributes.get("beta", 1.0) == 1.0
        weight = constants.get(node.input[1]) if node.op_type == "Gemm" else None
        if weight is None or not plain or attributes.get("transA"):
            nodes.append(node)
            continue
        count += 1
        name = node.input[1]
        if attributes.get("transB"):
            name = f"{name}.transposed"
            if name not in constants:
                turned = np.ascontiguousarray(onnx.numpy_helper.to_array(weight).T)
                constants[name] = onnx.numpy_helper.from_array(turned, name)
                model.graph.initializer.append(constants[name])
        biased = len(node.input) > 2 and node.input[2]
        product = f"{node.output[0]}.product" if biased else node.output[0]
        nodes.append(onnx.helper.make_node("MatMul", [node.input[0], name], [product], name=node.name))
        if biased:
            name = f"{node.name}/bias"
            nodes.append(onnx.helper.make_node("Add", [product, node.input[2]], [node.output[0]], name=name))
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return count


def part_inner_gemms(model: Any) -> None:
    """Give every Gemm inside an If, Loop or Scan that transposes a weight of the graph a copy of its own, in place."""
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    for number, node in enumerate(inner for outer in model.graph.node for inner in nodes_inside(outer)):
        turned = node.op_type == "Gemm" and any(item.name == "transB" and item.i for item in node.attribute)
        if turned and node.input[1] in constants:
            copy = model.graph.initializer.add()
            copy.CopyFrom(constants[node.input[1]])
            copy.name = node.input[1] = f"{copy.name}.{number}"


def _readers(model: Any) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for node in model.graph.node:
        for name in reads(node):
            found.setdefault(name, []).append(node)
    return found
