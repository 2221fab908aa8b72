"""Int8 weights that an x86 processor without VNNI multiplies exactly, at full speed.

Such a processor multiplies unsigned activations with signed weights in pairs and adds both products in 16 bits, with
saturation (``vpmaddubsw``). Both activations may be 255, so a pair is exact for all activations when the sum of its two
weights fits into int8: 255 x 128 = 32,640 still fits into 16 bits. Weights of 7 bits meet that bound individually. When
the sum of the pair is bounded instead, weights may use all 8 bits, since two large neighbours of one sign are rare: for
768 normally distributed weights the steps are 1.35 times as large as those of 8 bits, where 7 bits double them.

Which weights are neighbours depends on the kernel. Products accumulate along the inner axis; convolutions of both
engines accumulate all channels of a kernel position, then those of the next one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
LARGEST_SUM = 126
"""Largest magnitude of a sum of two weights before rounding, which may add 1."""


def neighbours(weight: Array, kind: str, axis: int) -> Iterator[tuple[Array, Array]]:
    """Yield the first and the second weights of all pairs, once for each accumulation order of an engine.

    Args:
        weight: Weight of any dtype, with at least two axes.
        kind: Operator: ``Conv``, ``Gemm`` or ``MatMul``.
        axis: Axis of the outputs.

    Yields:
        Two arrays of one shape, with the axis of outputs as in the weight.
    """
    if kind != "Conv":
        inner = -2 if axis == weight.ndim - 1 else -1
        first, second = ([slice(None)] * weight.ndim for _ in range(2))
        first[inner], second[inner] = slice(0, -1, 2), slice(1, None, 2)
        yield weight[tuple(first)], weight[tuple(second)]
        return
    outputs, channels = weight.shape[:2]
    channels_last = np.moveaxis(weight, 1, -1)
    orders = [channels_last]
    if channels % 2:  # OpenVINO pads the channels of each kernel position to a multiple of 4
        orders.append(np.concatenate([channels_last, np.zeros_like(channels_last[..., :1])], axis=-1))
    for order in orders:
        rows = order.reshape(outputs, -1)
        yield rows[:, 0:-1:2], rows[:, 1::2]


def largest_sums(weight: Array, kind: str, axis: int) -> Array:
    """Return the largest magnitude of a sum of two neighbours for each output, float32."""
    largest: Array = np.zeros(weight.shape[axis], np.float32)
    for first, second in neighbours(weight.astype(np.float32, copy=False), kind, axis):
        others = tuple(index for index in range(first.ndim) if index != (0 if kind == "Conv" else axis))
        largest = np.maximum(largest, np.abs(first + second).max(axis=others, initial=0.0))
    return largest


def pairs_fit(codes: Array, kind: str, axis: int) -> bool:
    """Return whether the sum of any two int8 neighbours fits into int8.

    Two numbers of one sign overflow when their sum in 8 bits has the other sign.
    """
    for first, second in neighbours(codes, kind, axis):
        cut = first + second
        if (((first ^ cut) & (second ^ cut)) < 0).any():
            return False
    return True
