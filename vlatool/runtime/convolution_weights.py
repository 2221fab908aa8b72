"""The sizes of the weights of each convolution of an ONNX graph: its bytes are walked.

Engines report the shapes of what a node reads, but not those of weights that they packed.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from vlatool.runtime.external_data import OpenFile, asked_of, fields, messages
from vlatool.runtime.weight_pairs import (
    DIMS,
    INPUT,
    OPERATOR,
    OUTPUT,
    TENSOR_NAME,
    WEIGHT_INPUT,
    packed_numbers,
    text_at,
)

NODE_NAME = 3
"""Number of ``NodeProto.name``."""
CONVOLUTIONS = {"ConvTranspose": 1, **{name: index for name, index in WEIGHT_INPUT.items() if "Conv" in name}}
"""Operator -> which input its weight is."""
FUSED_OPERATORS = frozenset((
    *("Relu", "LeakyRelu", "Sigmoid", "Tanh", "Clip", "HardSigmoid", "HardSwish"),
    *("Add", "Sum", "Mul", "BatchNormalization"),
))  # fmt: skip
"""Operators that ONNX Runtime computes within the convolution before them, which is then named after their output."""
Node = tuple[str, str, list[str], list[str]]
"""Name, operator, inputs, outputs."""


class ConvolutionWeights(NamedTuple):
    """Sizes of the weights of a convolution.

    Args:
        channels: Channels that it gives; of a ``ConvTranspose``, those that it takes.
        each: Weights of one of them.
    """

    channels: int
    each: int


def convolution_weights(model: Path | bytes) -> dict[str, ConvolutionWeights]:
    """Return name of a convolution, of what it gives, and of what is computed within it -> sizes of its weights.

    ONNX Runtime names a node that takes its place after one of them. Convolutions whose weights the graph computes,
    other than by ``DequantizeLinear``, are left out, and so is what may be computed within one of several.

    Args:
        model: A serialized ``ModelProto``, or the file of one.

    Raises:
        GraphError: for bytes that are not such a message, are deeper than the limit ``graph_depth`` or have more parts
            than ``graph_fields``.
        OSError: when there is no such file.
    """
    shapes: dict[str, list[int]] = {}
    nodes: list[Node] = []

    def read(content: bytes | OpenFile) -> bool:
        for message, start, end in messages(content, lambda *_: True):
            if message == "NodeProto":
                nodes.append(_node(content, start, end))
            elif message == "TensorProto":
                name, shape = _tensor(content, start, end)
                shapes[name] = shape
        return True

    asked_of(read, model)
    stored = {outputs[0]: inputs[0] for _, kind, inputs, outputs in nodes if kind == "DequantizeLinear" and outputs}
    readers = Counter(value for _, _, inputs, _ in nodes for value in inputs)
    found: dict[str, ConvolutionWeights] = {}
    for name, kind, inputs, outputs in nodes:
        if kind in FUSED_OPERATORS:
            before = {found[value] for value in inputs if value in found and readers[value] == 1}
            if len(before) == 1:
                found |= dict.fromkeys(filter(None, (name, *outputs)), before.pop())
            continue
        weight = "".join(inputs[CONVOLUTIONS[kind] :][:1]) if kind in CONVOLUTIONS else ""
        shape = shapes.get(stored.get(weight, weight), [])
        if len(shape) > 1:
            sizes = ConvolutionWeights(shape[0], math.prod(shape[1:]))
            found |= {each: sizes for each in (name, *outputs) if each}
    return found


def _node(model: bytes | OpenFile, start: int, end: int) -> Node:
    texts: dict[int, list[str]] = {field: [] for field in (NODE_NAME, OPERATOR, INPUT, OUTPUT)}
    for field, at, to, _ in fields(model, start, end):
        if field in texts:
            texts[field].append(text_at(model, at, to))
    return "".join(texts[NODE_NAME]), "".join(texts[OPERATOR]), texts[INPUT], texts[OUTPUT]


def _tensor(model: bytes | OpenFile, start: int, end: int) -> tuple[str, list[int]]:
    name, shape = "", []
    for field, at, to, number in fields(model, start, end):
        if field == DIMS:
            shape += [number] if number >= 0 else list(packed_numbers(model, at, to))
        elif field == TENSOR_NAME:
            name = text_at(model, at, to)
    return name, shape
