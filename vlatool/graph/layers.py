"""The layers of an ONNX graph that can be computed in int8, and their inputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from vlatool.errors import GraphError
from vlatool.graph.nodes import inner_nodes, varying_values
from vlatool.graph.onnx_graph import FLOAT, OnnxGraph

MIN_OPSET = 13
"""First opset with per-channel scales."""
MOVE_OPS = ("Reshape", "Transpose", "Unsqueeze", "Squeeze", "Flatten", "Split", "Slice", "MaxPool")
"""Operators that only move values: a value quantized before them stays quantized."""
SOFTMAXES = ("Softmax", "LogSoftmax")
MASK_OPS = (*MOVE_OPS, "Add", "Where", "Max", "Min", "Clip", "Cast", "Identity", "Mul", "Div")
"""Operators between a sum of scores and mask and its softmax."""
FUSED_ACTIVATIONS = ("Relu", "Clip")
"""Activation functions that engines fuse into the quantization of a convolution's output."""


@dataclass(frozen=True)
class Layer:
    """A node that can be computed in int8.

    Args:
        kind: Operator type.
        activations: Values that must be quantized at run time.
        weight: Initializer that is quantized ahead of time; empty when both operands are activations.
        axis: Axis of the weight with one scale for each entry.
        bias: Initializer of the bias, for convolutions.
        output: Output of the node, after a Relu or Clip that engines fuse.
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
    """Quantization style of layers.

    Args:
        activations: ``uint8`` with a zero point, ``int8`` symmetric, or ``symmetric``: int8, and uint8 with the zero
            point 0 for what is never negative.
        per_channel: One weight scale for each output channel.
        reduce_range: Weights of which no pair saturates 16 bits (``weights.pairs``).
        fused_convolutions: Quantize the bias and output of convolutions, too: ONNX Runtime then computes them in int8.
        hoist: Quantize before operators that only move values, so that they move bytes instead of floats.
        signed_second: Quantize the second of two multiplied activations (keys and values of attention) to signed 7
            bits, whatever the others are: ONNX Runtime multiplies uint8 with int8 twice as fast as with uint8 on x86,
            and within 63 no processor saturates.
        unsigned_convolutions: Quantize inputs of convolutions to uint8 with a zero point, whatever the others are.
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

    Values that do not depend on an input are left alone: engines compute them once, and OpenVINO (2026.4) fails on a
    graph in which such a value is quantized, or computes it wrongly.

    Args:
        model: An ``onnx.ModelProto``.
        ops: ``MatMul``, ``Gemm``, ``Conv``: operators whose layers with constant weights are returned.
        attention: Whether to include products of two activations.
        elementwise: Whether to include sums of two activations (residual connections), except sums of scores and mask,
            which a softmax reads.

    Raises:
        GraphError: when the opset is too old.
    """
    graph, live = OnnxGraph(model), varying_values(model)
    check_opset(graph.opset, "int8", MIN_OPSET)
    layers = []
    for node in model.graph.node:
        layer = None
        if node.op_type in ops or (node.op_type == "MatMul" and attention):
            layer = _product(node, graph, node.op_type in ops, attention)
        elif node.op_type == "Add" and elementwise and _is_residual(node, graph):
            layer = Layer(node.name, "Add", tuple(node.input))
        if layer is not None and live.issuperset(layer.activations):
            after = graph.readers[node.output[0]]
            fused = len(after) == 1 and after[0].op_type in FUSED_ACTIVATIONS
            layers.append(replace(layer, output=(after[0] if fused else node).output[0]))
    return layers


def check_opset(opset: int, method: str, lowest: int) -> None:
    """Refuse, with GraphError, an opset that lacks the operators of a method; 0 is an unknown opset."""
    if 0 < opset < lowest:
        raise GraphError(
            f"The graph has opset {opset}; {method} needs opset {lowest} or later.",
            f"convert the file that it came from: vlatool export FILE.onnx --opset {MIN_OPSET} -o BUNDLE; where "
            "onnx cannot convert it, export it again where it was made",
        )


def _is_residual(node: Any, graph: OnnxGraph) -> bool:
    """Return whether a node adds two float activations and its sum does not reach a softmax through moves."""
    floats = all(graph.types.get(name) == FLOAT and name not in graph.constants for name in node.input)
    sums, seen = [node.output[0]], set()
    while floats and sums:
        seen.add(value := sums.pop())
        if any(reader.op_type in SOFTMAXES for reader in graph.readers[value]):
            return False
        hoisted = (reader for reader in graph.readers[value] if reader.op_type in MASK_OPS)
        sums += [name for reader in hoisted for name in reader.output if name not in seen]
    return floats


def check_weights(model: Any, layers: Iterable[Layer]) -> None:
    """Check weights and biases of layers; raises GraphError, naming one and its layer, for NaN or infinity."""
    graph, names = OnnxGraph(model), {layer.name for layer in layers}
    for node in (node for node in model.graph.node if node.name in names):
        for name in filter(graph.is_weight, node.input):
            values = graph.array(name)
            bad = int(values.size - np.isfinite(values).sum())
            if bad:
                raise GraphError(
                    f"The weight '{name}' of the layer '{node.name}' holds NaN or infinity ({bad} of "
                    f"{values.size} values); allowed: finite ones.",
                    "check the checkpoint, or keep the layer in float32 with --exclude",
                )


def _product(node: Any, graph: OnnxGraph, weighted: bool, attention: bool) -> Layer | None:
    options, (first, second) = graph.attributes(node), node.input[:2]
    if not graph.is_weight(second) or len(graph.constants[second].dims) < 2:
        activations = first not in graph.constants and second not in graph.constants
        plain = node.op_type == "MatMul" and attention and activations
        return Layer(node.name, "MatMul", tuple(node.input)) if plain else None
    if not weighted or first in graph.constants or options.get("transA"):
        return None
    outputs_first = node.op_type == "Conv" or (node.op_type == "Gemm" and options.get("transB"))
    axis = 0 if outputs_first else len(graph.constants[second].dims) - 1
    bias = node.input[2] if node.op_type == "Conv" and len(node.input) > 2 else ""
    return Layer(node.name, node.op_type, (first,), second, axis, bias)


def hoisted_values(model: Any, layers: Iterable[Layer], style: Style) -> dict[str, str]:
    """Return input of a layer -> the value that is quantized instead, where they differ.

    The quantizer moves up through an operator of ``MOVE_OPS`` when all readers of the value are quantized layers and it
    is not an output of the graph; through Split always, whose other parts are then rounded, too.
    """
    if not style.hoist:
        return {}
    graph, read = OnnxGraph(model), {(layer.name, name) for layer in layers for name in layer.activations}
    roots: dict[str, str] = {}
    for name in sorted({name for _, name in read}):
        value = name
        while (mover := graph.producers.get(value)) is not None:
            if mover.op_type not in MOVE_OPS or mover.input[0] in graph.constants or value in graph.outputs:
                break
            readers = graph.readers[value]
            if not (len(readers) == 1 if value != name else all((reader.name, value) in read for reader in readers)):
                break
            roots[name] = value = mover.input[0]
    return roots


def calibrated_values(layers: Iterable[Layer], style: Style, hoisted: Mapping[str, str]) -> list[str]:
    """Return the values that need ranges, without repetition, in order."""
    values: dict[str, None] = {}
    for layer in layers:
        values.update(dict.fromkeys(hoisted.get(name, name) for name in layer.activations))
        if style.fused_convolutions and layer.kind == "Conv":
            values[layer.output] = None
    return list(values)


def convolution_inputs(layers: Iterable[Layer], style: Style, hoisted: Mapping[str, str]) -> set[str]:
    """Return the values that are quantized to uint8 because a convolution reads them.

    On x86 processors without AMX, OpenVINO (2025.2 to 2026.4) converts signed inputs of convolutions to unsigned ones,
    and loses their scale near a Concat; unsigned inputs are computed correctly everywhere.
    """
    if not style.unsigned_convolutions:
        return set()
    return {hoisted.get(name, name) for layer in layers if layer.kind == "Conv" for name in layer.activations}


def signed_values(layers: Iterable[Layer], style: Style) -> set[str]:
    """Return the values that are quantized to signed 7 bits, except those that are also read as first operands."""
    products = [layer for layer in layers if layer.kind == "MatMul" and not layer.weight]
    if not style.signed_second:
        return set()
    return {layer.activations[1] for layer in products} - {layer.activations[0] for layer in layers}


def split_gemms(model: Any) -> int:
    """Rewrite every plain Gemm with a constant weight as MatMul and Add, in place; return their number.

    ONNX Runtime has an integer MatMul with float output, but none for Gemm.
    """
    graph = OnnxGraph(model)
    nodes: list[Any] = []
    count = 0
    for node in model.graph.node:
        options = graph.attributes(node)
        plain = options.get("alpha", 1.0) == options.get("beta", 1.0) == 1.0 and not options.get("transA")
        if node.op_type != "Gemm" or node.input[1] not in graph.constants or not plain:
            nodes.append(node)
            continue
        count += 1
        weight, output = node.input[1], node.output[0]
        if options.get("transB"):
            weight = graph.add(f"{weight}.transposed", graph.array(weight).T)
        biased = len(node.input) > 2 and node.input[2]
        product = f"{output}.product" if biased else output
        nodes.append(graph.node("MatMul", [node.input[0], weight], [product], node.name))
        if biased:
            nodes.append(graph.node("Add", [product, node.input[2]], [output], f"{node.name}/bias"))
    graph.replace_nodes(nodes)
    return count


def copy_inner_gemm_weights(model: Any) -> None:
    """Copy the weights of the graph for each Gemm inside an If, Loop or Scan that transposes them, in place."""
    graph = OnnxGraph(model)
    for number, node in enumerate(inner for outer in model.graph.node for inner in inner_nodes(outer)):
        transposes = node.op_type == "Gemm" and graph.attributes(node).get("transB")
        if transposes and node.input[1] in graph.constants:
            weight = graph.constants[node.input[1]]
            node.input[1] = graph.add_tensor(weight, f"{weight.name}.{number}")
