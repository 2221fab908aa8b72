"""The profile of ONNX Runtime: the time of each node, and what it computes in."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.runtime.engine import FLOAT32, INT8, MOVES, MOVING, QUANTIZES, QUANTIZING, Node

INTEGER = ("MatMulInteger", "QLinear", "QGemm", "ConvInteger", "DynamicQuantize", "QAttention", "QEmbed")
Ran = tuple[int, tuple[tuple[int, ...], ...], tuple[tuple[int, ...], ...]]
CONTAINERS = ("If", "Loop", "Scan")
"""Their time is that of the nodes inside, which have entries of their own."""


class OrtProfiled:
    """A session with profiling on: ONNX Runtime writes a trace file of every node of every run."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self._outputs = [node.name for node in self._session.get_outputs()]

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        return dict(zip(self._outputs, self._session.run(self._outputs, feeds), strict=True))

    def ran(self) -> dict[str, Ran]:
        """Return node -> how often it ran, and the shapes of its inputs and of its outputs the last time."""
        seen: dict[str, Ran] = {}
        for event in json.loads(Path(self._session.end_profiling()).read_text(encoding="utf-8")):
            about, name = event.get("args", {}), event["name"].removesuffix("_kernel_time")
            if event["cat"] == "Node" and name != event["name"]:
                times = seen[name][0] + 1 if name in seen else 1
                seen[name] = (times, _shapes(about, "input_type_shape"), _shapes(about, "output_type_shape"))
        return seen

    def times(self) -> list[dict[Node, float]]:
        events = json.loads(Path(self._session.end_profiling()).read_text(encoding="utf-8"))
        starts = sorted(event["ts"] for event in events if event["name"] == "model_run")
        runs: list[dict[Node, float]] = [{} for _ in starts]
        for event in events:
            name, about = event["name"], event.get("args", {})
            if event["cat"] != "Node" or not name.endswith("_kernel_time") or about["op_name"] in CONTAINERS:
                continue
            dtypes = " ".join(next(iter(tensor)) for tensor in about.get("input_type_shape", ()) if tensor)
            key = (name.removesuffix("_kernel_time"), about["op_name"], dtypes)
            run = runs[bisect_right(starts, event["ts"]) - 1]
            run[key] = run.get(key, 0.0) + event["dur"]
        return runs


def _shapes(about: Mapping[str, Any], side: str) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(map(int, shape)) for tensor in about.get(side, ()) for shape in tensor.values())


def precision(node: Node) -> str:
    """Return what a node computes in."""
    _, kind, dtypes = node
    if kind in QUANTIZES:
        return QUANTIZING
    if kind in MOVES:
        return MOVING
    if kind.startswith(INTEGER):
        return INT8
    if kind == "MatMulNBits":
        return "int4 weights"
    first = dtypes.partition(" ")[0]
    return {"float": FLOAT32, "": FLOAT32, "double": "float64", "uint8": INT8, "int8": INT8}.get(first, first)
