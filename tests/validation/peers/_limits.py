"""What each engine reaches in the run: a large product in each dtype takes turns with the contestants."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from _workload import Array, Infer

from vlatool.measurement.reach import MACS, Product

LIMITS = {
    f"limit: {engine} {dtype}": (engine, dtype)
    for engine, dtypes in {
        "ort_cpu": ("float32", "int8"),
        "openvino": ("float32", "int8", "bfloat16"),
    }.items()
    for dtype in dtypes
}
"""Name of a contestant -> engine and dtype of its product."""
FAST, FLOAT, HALF = ("int8", "static", "dynamic"), "float32", "bfloat16"


def open_limit(name: str) -> Infer:
    """Open a product; what it is fed does not matter."""
    opened = Product(*LIMITS[name], 1)

    def infer(_feeds: object) -> Array:
        found: Array = opened.run()["y"][:1, :8]
        return found

    return infer


def macs_of(bundle: Path) -> float:
    """Return the multiply-accumulates of one inference of a bundle."""
    from vlatool.bundle.bundle import Bundle
    from vlatool.graph.workload import workload

    return float(sum(workload(Bundle.open(bundle)).macs.values()))


def dtype_of(name: str) -> str:
    """Return what most of a peer computes in, by its name."""
    if any(word in name for word in FAST):
        return "int8"
    return HALF if "bf16" in name else FLOAT


def share(macs: float, shares: Mapping[str, float], reach: Mapping[str, float], ms: float) -> float | None:
    """Return which part of a latency its work would take at the speed of the large products.

    Args:
        macs: Of one inference.
        shares: Dtype -> share of them.
        reach: Dtype -> milliseconds of the large product in that engine.
        ms: The latency.
    """
    if not macs or not shares or any(dtype not in reach for dtype in shares):
        return None
    return sum(part * macs / MACS * reach[dtype] for dtype, part in shares.items()) / ms
