"""Find what float16 loses because it is too small: values on recorded observations, and constants by their effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment
from vlatool.files.scratch import scratch_directory
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize.calibration.activation_taps import Watcher, run_watched
from vlatool.quantize.floats.float16_graph import HALF, LARGEST, around
from vlatool.stage.base import Context

LOSS = 0.01
"""Relative L2 error of a value from float16 alone that is too much; where all bits are there it is below 0.0005."""
LEAST_NONZERO = 2.0**-24
"""Smallest float16; the converter writes it for what is smaller and not zero."""
COARSE = 2.0**-18
"""Magnitude below which float16 is off by up to a hundredth and more."""
FEEDS = 4
"""Observations on which the converted graph is compared."""
SUMMED = {"Add": (0, 1), "Sub": (0, 1), "Sum": (0, 1, 2), "Max": (0, 1, 2), "Min": (0, 1, 2), "Clip": (1, 2),
          "Where": (1, 2), "Gemm": (2,), "Conv": (2,), "ConvTranspose": (2,), "LayerNormalization": (2,),
          "BatchNormalization": (2, 3, 4)}  # fmt: skip
"""Operator -> inputs that count by their size beside the output, not beside their own."""
NOTE = "vlatool.sizes"


@dataclass
class Sizes:
    """What a value was over all observations.

    Args:
        loss: Largest relative L2 error that float16 makes.
        typical: Smallest root mean square.
        least: Smallest magnitude other than zero.
    """

    loss: float = 0.0
    typical: float = np.inf
    least: float = np.inf


@dataclass
class Small:
    """Sizes of the values of a graph, and what it was fed on the first observations."""

    sizes: dict[str, Sizes] = field(default_factory=dict)
    feeds: list[dict[str, Any]] = field(default_factory=list)


class _Watching(Watcher):
    """Notes the sizes of every value."""

    def __init__(self, path: Path, copy: Path) -> None:
        self.found = Small()
        self._names: list[str] = []
        super().__init__(path, copy, self._show)

    def _show(self, graph: OnnxGraph) -> None:
        """Add for each float32 value its peak, mean square and error over the peak, and least, as one output."""
        self._names = graph.float_values()
        parts = [
            part for number, name in enumerate(self._names) for part in self._measured(graph, name, f"{NOTE}.{number}")
        ]
        if not parts:
            return
        graph.graph.node.append(graph.node("Concat", parts, [NOTE], axis=0))
        for name, value in (("zero", 0), ("one", 1), ("huge", np.inf)):
            graph.add(f"{NOTE}.{name}", value, np.float32)
        graph.add(f"{NOTE}.shape", [1], np.int64)
        graph.graph.output.append(graph.onnx.ValueInfoProto(name=NOTE))

    def _measured(self, graph: OnnxGraph, name: str, at: str) -> list[str]:
        zero, one, huge = (f"{NOTE}.{each}" for each in ("zero", "one", "huge"))

        def add(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
            graph.graph.node.append(graph.node(kind, inputs, [f"{at}.{output}"], **attributes))
            return f"{at}.{output}"

        def whole(kind: str, value: str, output: str) -> str:
            single = add(kind, [value], f"{output}.single", keepdims=0)
            return add("Reshape", [single, f"{NOTE}.shape"], output)

        finite = add("Where", [add("IsInf", [name], "inf"), zero, name], "finite")
        size = add("Abs", [finite], "abs")
        none = add("Equal", [size, zero], "none")
        peak = whole("ReduceMax", size, "peak")
        by = add("Where", [add("Equal", [peak, zero], "still"), one, peak], "by")
        rounded = add("Cast", [add("Cast", [finite], "half", to=HALF)], "float", to=1)
        error = add("Div", [add("Sub", [finite, rounded], "difference"), by], "error")
        return [
            peak, whole("ReduceMean", add("Mul", [error, error], "errors"), "mean_error"),
            whole("ReduceMean", add("Mul", [add("Div", [finite, by], "part")] * 2, "parts"), "mean"),
            whole("ReduceMin", add("Where", [none, huge, size], "nonzero"), "least"),
        ]  # fmt: skip

    def watch(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Take in the sizes."""
        if len(self.found.feeds) < FEEDS:
            self.found.feeds.append({name: np.array(value) for name, value in feeds.items()})
        measured = np.asarray(values.get(NOTE, ()), np.float64).reshape(-1, 4)
        for name, (peak, error, mean, least) in zip(self._names, measured.tolist(), strict=True):
            known = self.found.sizes.setdefault(name, Sizes())
            known.least = min(known.least, least)
            if mean > 0:
                known.loss = max(known.loss, float(np.sqrt(error / mean)))
                known.typical = min(known.typical, peak * float(np.sqrt(mean)))


def find_small(
    bundle: Bundle, graphs: Iterable[str], observations: Iterable[Mapping[str, Any] | Moment], context: Context
) -> dict[str, Small]:
    """Return graph -> the sizes of its values.

    Raises:
        DataError: when an observation does not fit the spec; names the sample.
    """
    files = {graph: bundle.file(bundle.manifest.graphs[graph].file) for graph in graphs}
    with scratch_directory() as scratch:
        watchers = {graph: _Watching(file, scratch / f"{graph}.onnx") for graph, file in files.items()}
        run_watched(bundle, watchers, observations, context, "looking for small values in")
    return {graph: watcher.found for graph, watcher in watchers.items()}


def too_small(model: Any, small: Small, kept: set[str], strict: bool) -> set[str]:
    """Return the names of the nodes that float16 would rob of what they compute.

    Those give or read a value that loses more than ``LOSS``, or read a constant that changes their output by so much:
    by its own relative error where they multiply, beside what they give where they add. Where an addend alone keeps a
    value from zero, what reads that value goes along until it is no longer small.

    Args:
        model: The float32 graph.
        small: What was seen of it.
        kept: Nodes that stay float32 in any case.
        strict: Go by every single number, not by whole tensors.
    """
    graph = OnnxGraph(model)
    values = {name for name, sizes in small.sizes.items() if sizes.loss > LOSS or (strict and sizes.least < COARSE)}
    nodes = around(model, values)
    pending = []
    for node in model.graph.node:
        names = [
            (place, name) for place, name in enumerate(node.input) if node.name not in kept and graph.is_weight(name)
        ]
        if any(_effect(graph.array(name), node, place, small, strict) > LOSS for place, name in names):
            nodes.add(node.name)
            pending.extend(node.output)
    while pending:
        name = pending.pop()
        if small.sizes.get(name, Sizes()).least < COARSE:
            readers = [node for node in graph.readers[name] if node.name not in nodes]
            nodes.update(node.name for node in readers)
            pending.extend(output for node in readers for output in node.output)
    return nodes


def _effect(array: NDArray[Any], node: Any, place: int, small: Small, strict: bool) -> float:
    """Return the relative error of a node's output from rounding one of its constants."""
    wide = array.astype(np.float64)
    sizes = np.abs(wide)
    if not sizes.size or not np.isfinite(wide).all() or sizes.max() > LARGEST:
        return 0.0
    rounded = np.where((sizes > 0) & (sizes < LEAST_NONZERO), np.copysign(LEAST_NONZERO, wide), wide)
    error = np.abs(rounded.astype(np.float16).astype(np.float64) - wide)
    if strict and place not in SUMMED.get(node.op_type, ()):
        return float((error / np.where(sizes > 0, sizes, 1)).max())
    own = _length(sizes)
    relative = _length(error) / own if own else 0.0
    if relative <= LOSS or place not in SUMMED.get(node.op_type, ()):
        return relative
    given = small.sizes.get(node.output[0], Sizes())
    beside = given.least if array.size == 1 else given.typical
    return float(np.sqrt(np.mean(error**2))) / beside if beside > 0 else np.inf


def _length(sizes: NDArray[Any]) -> float:
    """Return the L2 norm of magnitudes that may be too small to be squared."""
    largest = float(sizes.max())
    return largest * float(np.linalg.norm(sizes / largest)) if largest else 0.0
