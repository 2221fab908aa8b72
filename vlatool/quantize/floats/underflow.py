"""Find what float16 loses to underflow: values on recorded observations, and constants by their effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize.calibration.activation_taps import ActivationTap, run_with_taps
from vlatool.quantize.floats.float16_graph import FLOAT16, FLOAT16_MAX, nodes_touching
from vlatool.stage.base import Context

MAX_LOSS = 0.01
"""Largest relative L2 error that float16 may cause in a value; with full precision it is below 0.0005."""
LEAST_NONZERO = 2.0**-24
"""Smallest float16; the converter writes it for nonzero values below it."""
COARSE = 2.0**-18
"""Magnitude below which float16 is off by up to one percent or more."""
MAX_FEEDS = 4
"""Observations on which the converted graph is compared with the original."""
ADDEND_INPUTS = {"Add": (0, 1), "Sub": (0, 1), "Sum": (0, 1, 2), "Max": (0, 1, 2), "Min": (0, 1, 2), "Clip": (1, 2),
          "Where": (1, 2), "Gemm": (2,), "Conv": (2,), "ConvTranspose": (2,), "LayerNormalization": (2,),
          "BatchNormalization": (2, 3, 4)}  # fmt: skip
"""Operator -> inputs whose error counts relative to the output, not to the input itself."""
SIZES = "vlatool.sizes"


@dataclass
class ValueSizes:
    """Magnitudes of a value over all observations.

    Args:
        loss: Largest relative L2 error that float16 makes.
        typical: Smallest root mean square.
        least: Smallest magnitude other than zero.
    """

    loss: float = 0.0
    typical: float = np.inf
    least: float = np.inf


@dataclass
class GraphSizes:
    """Sizes of the values of a graph, and its inputs on the first observations."""

    values: dict[str, ValueSizes] = field(default_factory=dict)
    feeds: list[dict[str, Any]] = field(default_factory=list)


class _SizesTap(ActivationTap):
    """Records the sizes of every value."""

    def __init__(self, _graph: str, path: Path, copy: Path) -> None:
        self.measured = GraphSizes()
        super().__init__(path, copy)

    def add_outputs(self, graph: OnnxGraph) -> None:
        """Add one output: peak, mean square and error relative to the peak, and minimum of each float32 value."""
        self._names = graph.float_values()
        parts = [
            part for number, name in enumerate(self._names) for part in self._measure(graph, name, f"{SIZES}.{number}")
        ]
        if not parts:
            return
        graph.graph.node.append(graph.node("Concat", parts, [SIZES], axis=0))
        for name, value in (("zero", 0), ("one", 1), ("huge", np.inf)):
            graph.add(f"{SIZES}.{name}", value, np.float32)
        graph.add(f"{SIZES}.shape", [1], np.int64)
        graph.graph.output.append(graph.onnx.ValueInfoProto(name=SIZES))

    def _measure(self, graph: OnnxGraph, name: str, at: str) -> list[str]:
        zero, one, huge = (f"{SIZES}.{each}" for each in ("zero", "one", "huge"))

        def add(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
            graph.graph.node.append(graph.node(kind, inputs, [f"{at}.{output}"], **attributes))
            return f"{at}.{output}"

        def whole(kind: str, value: str, output: str) -> str:
            single = add(kind, [value], f"{output}.single", keepdims=0)
            return add("Reshape", [single, f"{SIZES}.shape"], output)

        finite = add("Where", [add("IsInf", [name], "inf"), zero, name], "finite")
        size = add("Abs", [finite], "abs")
        none = add("Equal", [size, zero], "none")
        peak = whole("ReduceMax", size, "peak")
        by = add("Where", [add("Equal", [peak, zero], "still"), one, peak], "by")
        rounded = add("Cast", [add("Cast", [finite], "half", to=FLOAT16)], "float", to=1)
        error = add("Div", [add("Sub", [finite, rounded], "difference"), by], "error")
        return [
            peak, whole("ReduceMean", add("Mul", [error, error], "errors"), "mean_error"),
            whole("ReduceMean", add("Mul", [add("Div", [finite, by], "part")] * 2, "parts"), "mean"),
            whole("ReduceMin", add("Where", [none, huge, size], "nonzero"), "least"),
        ]  # fmt: skip

    def observe(self, feeds: Mapping[str, Any], values: Mapping[str, Any]) -> None:
        """Update the sizes."""
        if len(self.measured.feeds) < MAX_FEEDS:
            self.measured.feeds.append({name: np.array(value) for name, value in feeds.items()})
        rows = np.asarray(values.get(SIZES, ()), np.float64).reshape(-1, 4)
        for name, (peak, error, mean, least) in zip(self._names, rows.tolist(), strict=True):
            known = self.measured.values.setdefault(name, ValueSizes())
            known.least = min(known.least, least)
            if mean > 0:
                known.loss = max(known.loss, float(np.sqrt(error / mean)))
                known.typical = min(known.typical, peak * float(np.sqrt(mean)))


def measure_sizes(
    bundle: Bundle, graphs: Iterable[str], observations: Iterable[Mapping[str, Any] | Moment], context: Context
) -> dict[str, GraphSizes]:
    """Return graph -> sizes of its values; raises DataError, naming the sample, when one does not fit the spec."""
    taps = run_with_taps(bundle, graphs, _SizesTap, observations, context, "looking for small values in")
    return {graph: tap.measured for graph, tap in taps.items()}


def underflow_nodes(model: Any, sizes: GraphSizes, excluded: set[str], strict: bool) -> set[str]:
    """Return the names of the nodes whose result float16 would destroy.

    They produce or read a value that loses more than ``MAX_LOSS``, or read a constant that changes their output by more
    than that: by its own relative error where they multiply, relative to the output where they add. Where only an
    addend keeps a value from zero, the readers of that value are included until it is no longer small.

    Args:
        excluded: Nodes that stay float32 in any case.
        strict: Whether every single element counts, instead of whole tensors.
    """
    graph = OnnxGraph(model)
    values = {name for name, size in sizes.values.items() if size.loss > MAX_LOSS or (strict and size.least < COARSE)}
    nodes = nodes_touching(model, values)
    pending = []
    for node in (node for node in model.graph.node if node.name not in excluded):
        names = [(index, name) for index, name in enumerate(node.input) if graph.is_weight(name)]
        if any(_effect(graph.array(name), node, index, sizes, strict) > MAX_LOSS for index, name in names):
            nodes.add(node.name)
            pending.extend(node.output)
    while pending:
        name = pending.pop()
        if sizes.values.get(name, ValueSizes()).least < COARSE:
            readers = [node for node in graph.readers[name] if node.name not in nodes]
            nodes.update(node.name for node in readers)
            pending.extend(output for node in readers for output in node.output)
    return nodes


def _effect(array: NDArray[Any], node: Any, index: int, graph_sizes: GraphSizes, strict: bool) -> float:
    """Return the relative error of a node's output from rounding one of its constants."""
    wide = array.astype(np.float64)
    sizes = np.abs(wide)
    if not sizes.size or not np.isfinite(wide).all() or sizes.max() > FLOAT16_MAX:
        return 0.0
    rounded = np.where((sizes > 0) & (sizes < LEAST_NONZERO), np.copysign(LEAST_NONZERO, wide), wide)
    error = np.abs(rounded.astype(np.float16).astype(np.float64) - wide)
    if strict and index not in ADDEND_INPUTS.get(node.op_type, ()):
        return float((error / np.where(sizes > 0, sizes, 1)).max())
    own = _norm(sizes)
    relative = _norm(error) / own if own else 0.0
    if relative <= MAX_LOSS or index not in ADDEND_INPUTS.get(node.op_type, ()):
        return relative
    given = graph_sizes.values.get(node.output[0], ValueSizes())
    reference = given.least if array.size == 1 else given.typical
    return float(np.sqrt(np.mean(error**2))) / reference if reference > 0 else np.inf


def _norm(sizes: NDArray[Any]) -> float:
    """Return the L2 norm of magnitudes that may be too small to be squared."""
    largest = float(sizes.max())
    return largest * float(np.linalg.norm(sizes / largest)) if largest else 0.0
