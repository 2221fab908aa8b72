"""Count what one inference of a bundle has to compute and move, from its ONNX graphs alone.

A multiply-accumulate (MAC) is one multiplication and one addition; biases, activations and normalisations are not
counted, as in the published tables that the predictions rest on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vlatool.bundle import Bundle
from vlatool.errors import GraphError, require
from vlatool.hwselect._macs import COMPUTE, INTEGER_OPS, node_macs, precision_of
from vlatool.hwselect._shapes import Tensors, open_graph


@dataclass(frozen=True)
class GraphWorkload:
    """What one run of a graph computes and moves.

    Args:
        macs: Precision (``float32``, ``int8``, ``int4`` ...) -> multiply-accumulates.
        layers: Compute layers (matrix products and convolutions).
        weight_bytes: Bytes of all initializers as they are stored.
        activation_bytes: Bytes that the compute layers write.
        peak_bytes: The most bytes of tensors, weights apart, that are alive at one node.
        integer_ops: Whether int8 is computed by integer operators (MatMulInteger and its kin) and not in QDQ form.
        unknown: Compute layers that cannot be counted, because their shapes are not static.
    """

    macs: Mapping[str, int] = field(default_factory=dict)
    layers: int = 0
    weight_bytes: int = 0
    activation_bytes: int = 0
    peak_bytes: int = 0
    integer_ops: bool = False
    unknown: tuple[str, ...] = ()


@dataclass(frozen=True)
class Workload:
    """What one inference of a policy computes and moves.

    Args:
        graphs: Graph name -> one run of it.
        runs: Graph name -> runs in one inference, by the program.
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
        """Bytes of live tensors, each open graph keeping its own."""
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
    graphs = {name: graph_workload(bundle.path / graph.file) for name, graph in bundle.manifest.graphs.items()}
    return Workload(graphs, dict(runs) or dict.fromkeys(graphs, 1))


def graph_workload(path: Path) -> GraphWorkload:
    """Count the work of one run of an ONNX file; a free first axis counts as 1.

    Raises:
        GraphError: when the file cannot be read.
        MissingExtra: when onnx is not installed.
    """
    onnx = require("onnx", "build")
    try:
        tensors = open_graph(onnx, path)
    except Exception as error:  # the seam: every exception type of onnx and protobuf becomes ours
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise GraphError(f"{path} cannot be read as ONNX: {reason}") from error
    return _count(tensors)


def _count(tensors: Tensors) -> GraphWorkload:
    macs: Counter[str] = Counter()
    layers = activation_bytes = 0
    unknown = [*tensors.hidden(COMPUTE)]
    for node in tensors.nodes:
        if node.op_type not in COMPUTE:
            continue
        layers += 1
        count = node_macs(node, tensors)
        written = [tensors.bytes_of(name) for name in node.output if name]
        if count is None or written[0] is None:
            unknown.append(node.name or node.output[0])
            continue
        macs[precision_of(node, tensors)] += count
        activation_bytes += sum(size or 0 for size in written)
    integer = any(node.op_type in INTEGER_OPS for node in tensors.nodes)
    return GraphWorkload(
        dict(macs), layers, tensors.weight_bytes, activation_bytes, tensors.peak_bytes(), integer, tuple(unknown)
    )
