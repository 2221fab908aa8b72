"""Multiply-accumulates of a node as an engine ran it, from the shapes that the engine reports.

Engines rename, merge and replace the nodes of a graph, and keep packed weights to themselves. What counts here is what
they say of the node that ran; for a convolution without its weights, the file says how many there are for one output.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from vlatool.runtime.convolution_weights import ConvolutionWeights

Shape = tuple[int, ...]
NUMBER_SUFFIX = re.compile(r"_?\d")
"""What makes a name that of another node: ``relu`` is not ``relu_1``, while ``relu_nchwc`` takes its place."""
ROWS = frozenset((
    *("MatMul", "FusedMatMul", "MatMulInteger", "MatMulIntegerToFloat", "DynamicQuantizeMatMul", "QLinearMatMul"),
    *("Gemm", "FusedGemm", "QGemm", "MatMulNBits", "TransposeMatMul", "GemmFloat8", "FullyConnected"),
))  # fmt: skip
"""Products of the rows of the first operand: ONNX, ONNX Runtime and OpenVINO."""
CONVOLUTIONS = frozenset((
    *("Conv", "FusedConv", "NhwcFusedConv", "NhwcConv", "QLinearConv", "ConvInteger", "Convolution"),
    "GroupConvolution",
))  # fmt: skip
PADDED_CONVOLUTIONS = ("Conv", "FusedConv")
"""Those whose channels (axis 1) ONNX Runtime rounds up to a whole number of blocks, and reports so."""
TRANSPOSED_CONVOLUTIONS = frozenset(("ConvTranspose", "Deconvolution", "ConvolutionBackpropData"))
GATES = {"LSTM": 4, "GRU": 3, "RNN": 1, "DynamicQuantizeLSTM": 4}
"""Recurrent operator -> matrices for each of input and state (onnx/defs/rnn/defs.cc)."""
ATTENTIONS = frozenset(("Attention", "MultiHeadAttention", "ScaledDotProductAttention"))
PRODUCTS = frozenset((*ROWS, *CONVOLUTIONS, *TRANSPOSED_CONVOLUTIONS, *GATES, *ATTENTIONS))
UNCOUNTED_OPERATORS = frozenset((
    *("QAttention", "PackedMultiHeadAttention", "PackedAttention", "GroupQueryAttention", "SparseAttention"),
    *("LongformerAttention", "DecoderMaskedMultiHeadAttention", "PagedAttention", "QOrderedAttention", "MoE", "QMoE"),
    *("Einsum", "DeformConv", "LSTMSequence", "GRUSequence", "RNNSeq", "RNNCell", "TensorIterator", "Loop"),
    *("LSTMCell", "GRUCell", "LLMMLP", "QKVProjection", "PagedAttentionExtension"),
))  # fmt: skip
"""Operators that multiply, and whose shapes alone do not tell how often."""


def macs(
    operator: str,
    inputs: Sequence[Shape],
    outputs: Sequence[Shape],
    weights: Mapping[str, ConvolutionWeights],
    name: str,
) -> int | None:
    """Return the multiply-accumulates of one run; 0 for what multiplies no matrices, None where the shapes do not tell.

    Args:
        operator: Type of the node, as the engine names it.
        inputs, outputs: Shapes that the engine reports, without those of packed weights.
        weights: Name of a convolution in the file, and of its output -> sizes of its weights.
        name: Name that the engine gives the node; that of a convolution begins with one of those.
    """
    if operator in UNCOUNTED_OPERATORS or is_compiled(operator):
        return None
    if not inputs or not outputs or not outputs[0]:
        return None if operator in PRODUCTS else 0
    first, out = inputs[0], outputs[0]
    if operator in ROWS:
        return math.prod(out) * _inner(first, out)
    if operator in CONVOLUTIONS:
        return _convolution(out, _weights(inputs, weights, name), operator in PADDED_CONVOLUTIONS)
    if operator in TRANSPOSED_CONVOLUTIONS:
        return _convolution(first, _weights(inputs, weights, name))
    if operator in GATES:
        return first[0] * math.prod(outputs[-1][-3:]) * GATES[operator] * (first[-1] + out[-1])
    if operator in ATTENTIONS:
        return _attention(inputs, outputs)
    return 0


def is_compiled(operator: str) -> bool:
    """Return whether a node is a part of the graph that a provider compiled, such as ``TRTKernel_graph_1``.

    No operator of ONNX or ONNX Runtime has an underscore or a hyphen in its name.
    """
    return "_" in operator or "-" in operator


def _inner(first: Shape, out: Shape) -> int:
    """Return the length of the sums of a product; the last axis of a transposed first operand is that of the rows."""
    if len(first) < 2 or len(out) < 2 or first[-2] == out[-2] or first[-1] != out[-2]:
        return first[-1]
    return first[-2]


def _weights(
    inputs: Sequence[Shape], weights: Mapping[str, ConvolutionWeights], name: str
) -> ConvolutionWeights | None:
    """Return the sizes of the weights of a convolution: from the file, else as reported."""
    if known := [known for known in weights if name.startswith(known) and not NUMBER_SUFFIX.match(name[len(known) :])]:
        return weights[max(known, key=len)]
    kernel = next((shape for shape in inputs[1:] if len(shape) >= len(inputs[0])), None)
    if kernel is None:
        return None
    groups = len(kernel) - len(inputs[0])  # OpenVINO has an axis of them before those of the weights
    return ConvolutionWeights(math.prod(kernel[: groups + 1]), math.prod(kernel[groups + 1 :]))


def _convolution(values: Shape, weights: ConvolutionWeights | None, padded: bool = False) -> int | None:
    """Return how often a convolution multiplies, for all values that it gives, or takes if it is transposed."""
    if weights is None:
        return None
    whole = math.prod(values)
    return (whole // values[1] * weights.channels if padded else whole) * weights.each


def _attention(inputs: Sequence[Shape], outputs: Sequence[Shape]) -> int | None:
    """Return query x key + weights x value, of (batch, heads, length, width) or (batch, length, heads x width)."""
    if len(inputs) < 3 or len({len(shape) for shape in inputs[:3]}) != 1 or len(inputs[0]) not in (3, 4):
        return None
    query, key, out = inputs[0], inputs[1], outputs[0]
    length = key[-2] if len(outputs) < 2 or len(outputs[1]) != 4 else outputs[1][2]  # with the keys of before
    return math.prod(query[:-1]) * length * (query[-1] + out[-1])
