"""Count the computation and data movement of one inference of a bundle, from its ONNX graphs.

A multiply-accumulate (MAC) is one multiplication and one addition; biases, activations and normalisations are not
counted, as in the published tables that the predictions are based on.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, require
from vlatool.graph.macs import COMPUTE, CONVOLUTIONS, INTEGER_OPS, node_macs, precision_of, second_operand
from vlatool.graph.nodes import matches
from vlatool.graph.shapes import Tensors, open_graph

MAX_DEPTHWISE_PRODUCTS = 121
"""Largest number of products for each output element of a depthwise convolution (11 x 11)."""
MAX_ROW_REUSE = 2
"""Largest number of uses of each weight in a product of one row."""
TRAITS = ("depthwise", "attention", "grouped", "branches", "dense")
"""Depthwise convolutions; products of activations (attention); grouped convolutions; concatenated branches; most
weights in matrix products of one row (the dense head of an early network, or the decoding of a language model)."""


@dataclass(frozen=True)
class GraphWorkload:
    """Computation and data movement of one run of a graph.

    Args:
        macs: Precision (``float32``, ``int8``, ``int4`` ...) -> multiply-accumulates.
        layers: Compute layers (matrix products and convolutions).
        weights: Elements of the weights of the compute layers, each weight once, whatever its format.
        activations: Elements that the compute layers write.
        traits: Traits of ``TRAITS`` that published latencies depend on.
        weight_bytes: Stored bytes of all initializers.
        activation_bytes: Bytes that the compute layers write.
        peak_bytes: Peak of bytes of live tensors, without weights.
        integer_ops: Whether int8 is computed by integer operators (MatMulInteger and similar) instead of QDQ.
        unknown: Compute layers that cannot be counted because their shapes are not static.
        parts: Part of the policy (vision, language ...; empty: none) -> multiply-accumulates, reads of weights,
            activations and layers of its compute layers, without unknown ones.
        read_again: Elements that are read from a weight after the first time, as in iterations of a loop.
    """

    macs: Mapping[str, int] = field(default_factory=dict)
    layers: int = 0
    weights: int = 0
    activations: int = 0
    traits: frozenset[str] = frozenset()
    weight_bytes: int = 0
    activation_bytes: int = 0
    peak_bytes: int = 0
    integer_ops: bool = False
    unknown: tuple[str, ...] = ()
    parts: Mapping[str, tuple[int, int, int, int]] = field(default_factory=dict)
    read_again: int = 0

    @property
    def reads(self) -> int:
        """Elements that one run reads from weights."""
        return self.weights + self.read_again


@dataclass(frozen=True)
class Workload:
    """Computation and data movement of one inference of a policy.

    Args:
        graphs: Graph name -> workload of one run.
        runs: Graph name -> runs in one inference of the program.
    """

    graphs: Mapping[str, GraphWorkload]
    runs: Mapping[str, int]

    @property
    def macs(self) -> dict[str, int]:
        """Precision -> multiply-accumulates of one inference."""
        total: Counter[str] = Counter()
        for name, graph in self.graphs.items():
            total.update({precision: count * self.runs.get(name, 0) for precision, count in graph.macs.items()})
        return dict(total)

    @property
    def layers(self) -> int:
        """Compute layers of one inference, repeats counted."""
        return sum(graph.layers * self.runs.get(name, 0) for name, graph in self.graphs.items())

    @property
    def weight_bytes(self) -> int:
        """Bytes of the weights of all graphs, each once."""
        return sum(graph.weight_bytes for graph in self.graphs.values())

    @property
    def peak_bytes(self) -> int:
        """Peak of bytes of live tensors, summed over the graphs, which stay open."""
        return sum(graph.peak_bytes for graph in self.graphs.values())

    @property
    def unknown(self) -> tuple[str, ...]:
        """Layers that cannot be counted, as ``graph/layer``."""
        return tuple(f"{name}/{layer}" for name, graph in self.graphs.items() for layer in graph.unknown)


def workload(bundle: Bundle) -> Workload:
    """Count the work of one inference of a bundle.

    Raises:
        GraphError: when a graph cannot be read.
        MissingExtra: when onnx is not installed.
    """
    runs: Counter[str] = Counter()
    for step in bundle.manifest.program:
        runs[step.graph] += step.repeat
    parts = bundle.manifest.parts
    graphs = {name: graph_workload(bundle.path / graph.file, parts) for name, graph in bundle.manifest.graphs.items()}
    return Workload(graphs, dict(runs) or dict.fromkeys(graphs, 1))


def graph_workload(
    path: Path, parts: Mapping[str, Sequence[str]] | None = None, count_as: Callable[[Any, Tensors], str] = precision_of
) -> GraphWorkload:
    """Count the work of one run of an ONNX file; a free first axis counts as 1.

    Args:
        parts: Part of the policy -> globs of module names, to count each by itself.
        count_as: Function that returns the category of a layer's multiply-accumulates.

    Raises:
        GraphError: when the file cannot be read.
        MissingExtra: when onnx is not installed.
    """
    onnx = require("onnx", "build")
    try:
        tensors = open_graph(onnx, path)
    except Exception as error:  # the seam: every exception type of onnx and protobuf becomes ours
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise GraphError(
            f"{path} cannot be read as ONNX: {reason}",
            "check that the file is complete: onnx.checker.check_model(FILE); make a bundle again",
        ) from error
    return _count(tensors, parts or {}, count_as)


def part_of(name: str, parts: Mapping[str, Sequence[str]]) -> str:
    """Return the first part that a module, or a node named after one (``head/MatMul``), belongs to; empty for none."""
    return next((part for part, globs in parts.items() if matches(name, tuple(globs))), "")


def _count(
    tensors: Tensors, parts: Mapping[str, Sequence[str]], count_as: Callable[[Any, Tensors], str]
) -> GraphWorkload:
    macs: Counter[str] = Counter()
    tally = Tally()
    activation_bytes = 0
    unknown = [*tensors.nodes_with_inner(COMPUTE)]

    def macs_of(node: Any) -> int:
        return (node.op_type in COMPUTE and node_macs(node, tensors)) or 0

    for node, times in tensors.run_counts(tensors.items, macs_of):
        tally.add_concat(node.op_type == "Concat")
        if node.op_type not in COMPUTE:
            continue
        count = node_macs(node, tensors)
        written = [tensors.bytes_of(name) for name in node.output if name]
        if count is None or written[0] is None or not times:
            tally.layers += 1
            unknown.append(node.name or node.output[0])
            continue
        macs[count_as(node, tensors)] += times * count
        activation_bytes += times * sum(size or 0 for size in written)
        part = part_of(node.name, parts)
        written_numbers = math.prod(tensors.shape(node.output[0]) or ())
        weights, groups = _operands(node, tensors)
        weight = tensors.source_tensor(second_operand(node))
        tally.add_layer(count, written_numbers, weights, groups, part, weight, times)
    integer = any(node.op_type in INTEGER_OPS for node in tensors.nodes)
    return GraphWorkload(
        dict(macs), tally.layers, tally.weights, tally.activations, tally.traits(), tensors.weight_bytes,
        activation_bytes, tensors.peak_bytes(), integer, tuple(unknown), tally.parts(), tally.read_again,
    )  # fmt: skip


def _operands(node: Any, tensors: Tensors) -> tuple[int, int]:
    """Return the elements of a layer's weight (0 for a product of activations) and the groups of a convolution."""
    if node.op_type == "MatMulNBits":
        return int(tensors.attribute(node, "K", 0)) * int(tensors.attribute(node, "N", 0)), 1
    second = second_operand(node)
    shape = tensors.shape(second) or ()
    groups = int(tensors.attribute(node, "group", 1)) if node.op_type in CONVOLUTIONS else 1
    return (math.prod(shape) if tensors.is_constant(second) else 0), groups


@dataclass
class Tally:
    """Sums over the compute layers of a graph, whatever their source."""

    layers: int = 0
    weights: int = 0
    read_again: int = 0
    activations: int = 0
    _concats: int = 0
    _macs: int = 0
    _depthwise: int = 0
    _grouped: int = 0
    _products: int = 0
    _rows: int = 0
    _parts: dict[str, tuple[int, int, int, int]] = field(default_factory=dict)
    _seen: set[Hashable] = field(default_factory=set)

    def add_layer(
        self,
        macs: int,
        written: int,
        weights: int,
        groups: int = 1,
        part: str = "",
        weight: Hashable = "",
        times: int = 1,
    ) -> None:
        """Add a layer: its multiply-accumulates, the elements that it writes, its weights, groups and part.

        Args:
            weight: Identity of its weight; a known weight is read again, not stored again. Empty: a new weight.
        """
        before = self._parts.get(part, (0, 0, 0, 0))
        added = zip(before, (times * macs, times * weights, times * written, times), strict=True)
        self._parts[part] = tuple(old + new for old, new in added)  # type: ignore[assignment]
        again = times - (weight not in self._seen)
        self.layers += times
        self.weights += (times - again) * weights
        self.read_again += again * weights
        self._seen.update([weight] if weight else [])
        self.activations += times * written
        self._macs += times * macs
        self._depthwise += times * (groups > 1 and macs <= MAX_DEPTHWISE_PRODUCTS * written)
        self._grouped += times * (macs if groups > 1 and macs > MAX_DEPTHWISE_PRODUCTS * written else 0)
        self._products += times * (macs if not weights else 0)
        self._rows += times * (weights if macs <= MAX_ROW_REUSE * weights else 0)

    def add_concat(self, concatenates: bool) -> None:
        """Add a node that may be a concatenation."""
        self._concats += concatenates

    def parts(self) -> dict[str, tuple[int, int, int, int]]:
        """Return the sums of each part; empty when no layer belongs to a part."""
        return dict(self._parts) if set(self._parts) - {""} else {}

    def traits(self) -> frozenset[str]:
        """Return the traits of ``TRAITS`` that the graph has."""
        layers, macs, weights = max(1, self.layers), max(1, self._macs), max(1, self.weights + self.read_again)
        has = (
            self._depthwise >= 0.15 * layers, self._products >= 0.005 * macs, self._grouped >= 0.2 * macs,
            self._concats >= 0.1 * layers, self._rows >= 0.6 * weights,
        )  # fmt: skip
        return frozenset(trait for trait, present in zip(TRAITS, has, strict=True) if present)


WORKLOAD_TABLE = "workload"
"""Table in a benchmark's row with the workload of one inference."""


def summarize_workload(load: Workload) -> dict[str, Any]:
    """Return the work of one inference as one record: sums over its graphs and their repeats."""
    runs = [(load.graphs[name], count) for name, count in load.runs.items()]
    macs = [float(sum(graph.macs.values())) * count for graph, count in runs]
    return {
        "macs": sum(macs, 0.0),
        "weights": float(sum(graph.reads * count for graph, count in runs)),
        "activations": float(sum(graph.activations * count for graph, count in runs)),
        "layers": float(sum(graph.layers * count for graph, count in runs)),
        "traits": sorted(set().union(*(graph.traits for graph, _ in runs))),
        "precision": stored_precision(runs[macs.index(max(macs))][0]) if runs else "float32",
    }


def stored_precision(graph: GraphWorkload) -> str:
    """Return the precision of most of a graph's multiply-accumulates."""
    most = max(graph.macs, key=lambda name: graph.macs[name], default="float32")
    return {"int4": "w4", "uint8": "int8", "float4": "float8"}.get(most, most if most in PRECISIONS else "float32")


PRECISIONS = {
    "float32": (4.0, 4.0), "float16": (2.0, 2.0), "bfloat16": (2.0, 2.0), "float8": (1.0, 1.0), "int8": (1.0, 1.0),
    "w8": (1.0, 2.0), "w4": (0.5625, 2.0),
}  # fmt: skip
"""Precision -> bytes of a weight and of an activation; w4 counts a 16-bit scale for each 32 weights."""
