"""What a quantized graph loses between its int8 layers: round trips through float, and layers that fell back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.errors import require
from vlatool.explain._operators import Operator
from vlatool.runtime.engine import FLOAT32, MOVES, Engine, engine_class

QUANTIZERS = ("QuantizeLinear", "DynamicQuantizeLinear")
COMPUTING = ("MatMul", "Gemm", "Conv", "ConvTranspose", "Einsum", "Attention")
INTEGER = ("MatMulIntegerToFloat", "MatMulInteger", "ConvInteger", "DynamicQuantizeMatMul")
LONGEST = 4
"""Operators between a DequantizeLinear and the next QuantizeLinear that still count as one island."""


@dataclass(frozen=True)
class Island:
    """A value that leaves int8, is computed in float by a few light operators, and is quantized again.

    Args:
        graph: Name of the graph.
        start: Name of the DequantizeLinear.
        between: Operator types in between; empty when QuantizeLinear follows at once.
        end: Name of the QuantizeLinear.
        nodes: Names of all its nodes.
        ms: What the profile shows for nodes of those names in one inference; 0 when the engine fused them away.
    """

    graph: str
    start: str
    between: tuple[str, ...]
    end: str
    nodes: tuple[str, ...]
    ms: float = 0.0


@dataclass(frozen=True)
class Fallback:
    """A layer that is int8 in the file and does not run as the fast int8 kernel, and what that costs.

    Args:
        graph, layer: Where it is.
        why: What happened, in words.
        ms: Time of one inference that it takes.
    """

    graph: str
    layer: str
    why: str
    ms: float


class QuantizedGraph:
    """The nodes of an ONNX file, seen from its int8 layers."""

    def __init__(self, name: str, path: Path) -> None:
        onnx = require("onnx", "build")
        self.name = name
        model = onnx.load(str(path), load_external_data=False)
        graph = model.graph
        self.nodes = list(graph.node)
        self.types = {tensor.name: tensor.data_type for tensor in graph.initializer}
        self.producers = {name: node for node in self.nodes for name in node.output if name}
        self.readers: dict[str, list[Any]] = {}
        for node in self.nodes:
            for value in node.input:
                self.readers.setdefault(value, []).append(node)
        self._zeros = {
            tensor.name: onnx.numpy_helper.to_array(tensor)
            for tensor in graph.initializer
            if tensor.data_type in (2, 3) and len(tensor.dims) == 0
        }

    def layers(self) -> list[str]:
        """Return the names of the layers that are int8 in the file."""
        return [node.name for node in self.nodes if node.op_type in INTEGER or self._paired(node)]

    def pairs(self) -> tuple[int, int]:
        """Return how many values are quantized, and how many are dequantized, at run time."""
        first = sum(node.op_type in QUANTIZERS for node in self.nodes)
        return first, sum(self._activation(node) for node in self.nodes)

    def islands(self) -> list[Island]:
        """Return the round trips: int8 -> float -> int8 with nothing but light operators in between."""
        found = []
        for node in self.nodes:
            if self._activation(node):
                found += self._ways(node)
        return found

    def asymmetric(self) -> list[str]:
        """Return the quantizers of activations with a zero point other than 0."""
        return [
            node.name
            for node in self.nodes
            if node.op_type == "QuantizeLinear" and len(node.input) > 2 and self._zeros.get(node.input[2], 0) != 0
        ]

    def _activation(self, node: Any) -> bool:
        return node.op_type == "DequantizeLinear" and node.input[0] not in self.types

    def _paired(self, node: Any) -> bool:
        """Whether both operands of a float layer are dequantized, perhaps moved since."""
        if node.op_type not in COMPUTING or len(node.input) < 2:
            return False
        sources = [self._source(name) for name in node.input[:2]]
        return all(source is not None and source.op_type == "DequantizeLinear" for source in sources)

    def _source(self, value: str) -> Any:
        """Return the node that gave a value before it was moved; None for an input or a constant."""
        node = self.producers.get(value)
        while node is not None and node.op_type in (*MOVES, "MaxPool"):
            node = self.producers.get(node.input[0])
        return node

    def _ways(self, start: Any) -> list[Island]:
        """Follow a dequantized value to each QuantizeLinear that it reaches without a heavy layer on the way."""
        found = []
        pending: list[tuple[str, tuple[Any, ...]]] = [(start.output[0], ())]
        while pending:
            value, way = pending.pop()
            for reader in self.readers.get(value, ()):
                if reader.op_type in QUANTIZERS:
                    names = tuple(node.name for node in (start, *way, reader))
                    kinds = tuple(node.op_type for node in way)
                    found.append(Island(self.name, start.name, kinds, reader.name, names))
                elif reader.op_type not in (*COMPUTING, *INTEGER) and len(way) < LONGEST:
                    pending.append((reader.output[0], (*way, reader)))
        return found


def timed(islands: Iterable[Island], operators: Sequence[Operator]) -> list[Island]:
    """Return the islands with what their nodes cost in the profile, the dearest first."""
    spent: dict[tuple[str, str], float] = {}
    for each in operators:
        spent[each.graph, each.name] = spent.get((each.graph, each.name), 0.0) + each.ms
    made = [
        Island(
            each.graph,
            each.start,
            each.between,
            each.end,
            each.nodes,
            sum(spent.get((each.graph, name), 0.0) for name in each.nodes),
        )
        for each in islands
    ]
    return sorted(made, key=lambda each: -each.ms)


def fallbacks(graph: QuantizedGraph, operators: Sequence[Operator], engine: str) -> list[Fallback]:
    """Return the int8 layers of a file that the engine did not run as fast int8 kernels, the dearest first."""
    own = [each for each in operators if each.graph == graph.name]
    found = [*_in_float(graph, own), *_weights(graph, own)]
    found += _slow(graph, own, engine_class(engine))
    return sorted(found, key=lambda each: -each.ms)


def _in_float(graph: QuantizedGraph, operators: Sequence[Operator]) -> list[Fallback]:
    """Find layers that are int8 in the file and a float product in the profile."""
    layers = set(graph.layers())
    why = "int8 in the file, computed in float: the engine did not fuse its quantize-dequantize pairs"
    found = []
    for each in operators:
        layer = next((name for name in (each.name, each.name.partition("/MatMul")[0]) if name in layers), "")
        layer = layer or next((name for name in layers if each.name.startswith((f"{name}/", f"{name}_token_"))), "")
        if each.product and each.precision == FLOAT32 and layer:
            found.append(Fallback(graph.name, layer, why, each.ms))
    return found


def _weights(graph: QuantizedGraph, operators: Sequence[Operator]) -> list[Fallback]:
    """Find weights that are dequantized at every inference."""
    stored = {
        node.name: node for node in graph.nodes if node.op_type == "DequantizeLinear" and node.input[0] in graph.types
    }
    why = "its int8 weight is dequantized to float at every inference"
    found = []
    for each in operators:
        node = stored.get(each.name)
        if node is not None and each.kind == "DequantizeLinear":
            readers = graph.readers.get(node.output[0], [])
            found.append(Fallback(graph.name, readers[0].name if readers else each.name, why, each.ms))
    return found


def _slow(graph: QuantizedGraph, operators: Sequence[Operator], library: type[Engine]) -> list[Fallback]:
    """Find int8 nodes that do not run as the engine's fast kernels, as it says itself."""
    zero_points = len(graph.asymmetric())
    told = ((each, library.slow(each.node, each.precision, each.product, zero_points)) for each in operators)
    return [Fallback(graph.name, each.name, why, each.ms) for each, why in told if why]
