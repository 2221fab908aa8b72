"""The profile of ONNX Runtime: the time of each node, and what it computes in."""

from __future__ import annotations

import contextlib
import json
import math
from bisect import bisect_right
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError
from vlatool.runtime.convolution_weights import ConvolutionWeights, convolution_weights
from vlatool.runtime.engine import FLOAT32, INT8, MOVES, MOVING, QUANTIZES, QUANTIZING, Node, NodeRun
from vlatool.runtime.engines._products import is_compiled, macs

INTEGER = ("MatMulInteger", "QLinear", "QGemm", "ConvInteger", "DynamicQuantize", "QAttention", "QEmbed")
Ran = tuple[int, tuple[tuple[int, ...], ...], tuple[tuple[int, ...], ...]]
CONTAINERS = ("If", "Loop", "Scan")
"""Their time is that of the nodes inside, which have entries of their own."""


class Trace:
    """The nodes of the first run of a session, which ONNX Runtime writes into a temporary file.

    Args:
        model: The graph: what it says of convolutions is read now, since its file may be replaced later.
    """

    def __init__(self, model: Path | bytes) -> None:
        import shutil  # a robot without a record does without these
        import tempfile
        import weakref

        self.folder = tempfile.mkdtemp(prefix="vlatool-trace-")
        """Where ONNX Runtime writes."""
        self._remove = weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)
        self._weights: Mapping[str, ConvolutionWeights] = {}
        with contextlib.suppress(GraphError, OSError):  # the session names what is wrong with it
            self._weights = convolution_weights(model)

    def end(self, session: Any) -> list[NodeRun]:
        """Let a session note no further nodes, and return those of its first run; none where they cannot be read."""
        try:
            return node_runs(Path(session.end_profiling()), self._weights)
        except (OSError, ValueError, LookupError):
            return []
        finally:
            self._remove()


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
            key = (name.removesuffix("_kernel_time"), about["op_name"], _dtypes(about))
            run = runs[bisect_right(starts, event["ts"]) - 1]
            run[key] = run.get(key, 0.0) + event["dur"]
        return runs


def node_runs(trace: Path, weights: Mapping[str, ConvolutionWeights]) -> list[NodeRun]:
    """Return the nodes of the first run in a trace of ONNX Runtime, those inside of branches and loops each time.

    Args:
        trace: The file that ``end_profiling`` wrote.
        weights: Convolution of the graph -> sizes of its weights; a trace lacks those that ONNX Runtime packed.
    """
    events = json.loads(trace.read_text(encoding="utf-8"))
    last = min((event["ts"] + event["dur"] for event in events if event["name"] == "model_run"), default=math.inf)
    return [
        _node_run(event["name"].removesuffix("_kernel_time"), event["args"], weights)
        for event in events
        if event["cat"] == "Node" and event["name"].endswith("_kernel_time") and event["ts"] <= last
        if event["args"]["op_name"] not in CONTAINERS
    ]


def _node_run(name: str, about: Mapping[str, Any], weights: Mapping[str, ConvolutionWeights]) -> NodeRun:
    kind = str(about["op_name"])
    inputs, outputs = _shapes(about, "input_type_shape"), _shapes(about, "output_type_shape")
    computed = "" if is_compiled(kind) else precision((name, kind, _dtypes(about)))
    return NodeRun(name, kind, str(about.get("provider", "")), computed, macs(kind, inputs, outputs, weights, name))


def _dtypes(about: Mapping[str, Any]) -> str:
    return " ".join(next(iter(tensor)) for tensor in about.get("input_type_shape", ()) if tensor)


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
