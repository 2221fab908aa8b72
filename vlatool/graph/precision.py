"""Shares of a graph's multiply-accumulates by the precision of the computation, or of the weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

FLOATS = ("float64", "float32", "float16")
"""Precisions of a graph that is not quantized yet."""


def precision_shares(path: Path) -> dict[str, float]:
    """Return precision -> share of the multiply-accumulates (rounded to 0.001, the largest first).

    Layers with only quantized weights count as ``int4 weights`` and the like, whatever their storage format.
    """
    return shares_and_unknown(path)[0]


def shares_and_unknown(path: Path) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return those shares, and the layers that cannot be counted because their shapes are unknown."""
    from vlatool.graph.workload import graph_workload

    load = graph_workload(path, count_as=_by_weights)
    total = sum(load.macs.values()) or 1
    shares = {name: round(count / total, 3) for name, count in load.macs.items() if count}
    return dict(sorted(shares.items(), key=lambda item: -item[1])), load.unknown


def _by_weights(node: Any, tensors: Any) -> str:
    from vlatool.graph.macs import precision_of, weight_precision

    alone = weight_precision(node, tensors)
    return f"{alone} weights" if alone else precision_of(node, tensors)
