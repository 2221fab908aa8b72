"""NaN and infinity in inputs that take them: ``finite: false`` in the spec, such as depth images without a return."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec

KINDS = ((math.nan, math.inf, -math.inf), (), (math.nan,), (-math.inf, math.inf))
"""What observations hold in turn; those of the second kind stay as they are."""
SHARE = 8
"""One in so many values is not finite, and no more than half of them."""


def takes_not_finite(spec: PolicySpec) -> list[TensorSpec]:
    """Return the inputs that may hold NaN and infinity."""
    return [tensor for tensor in spec.inputs if not tensor.finite]


def with_not_finite(
    spec: PolicySpec, observations: Sequence[Mapping[str, Any]], first: int = 0
) -> list[dict[str, Any]]:
    """Return observations, three in four of which hold NaN or infinity in a part of each input that takes them.

    Which values, follows from the number of the observation alone: twice is as once.

    Args:
        observations: Without the batch axis; they stay as they are.
    """
    tensors = takes_not_finite(spec)
    return [
        {**each, **{tensor.name: _spread(tensor, each[tensor.name], [number, at]) for at, tensor in enumerate(tensors)}}
        for number, each in enumerate(observations, first)
    ]


def _spread(tensor: TensorSpec, value: Any, position: list[int]) -> Any:
    kinds = KINDS[position[0] % len(KINDS)]
    if not kinds:
        return value
    array: NDArray[Any] = np.array(value, tensor.dtype)
    count = min(max(len(kinds), array.size // SHARE), max(1, array.size // 2))
    chosen = np.random.default_rng(position).permutation(array.size)[:count]
    array.reshape(-1)[chosen] = [kinds[(position[0] // len(KINDS) + at) % len(kinds)] for at in range(count)]
    return array
