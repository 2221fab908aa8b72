"""What a quantized graph loses between its int8 layers: round trips through float, and layers that fell back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.errors import require
from vlatool.explain._operators import Operator
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.runtime.engine import FLOAT32, MOVES, Engine, engine_class

QUANTIZERS = ("QuantizeLinear", "DynamicQuantizeLinear")
COMPUTING = ("MatMul", "Gemm", "Conv", "ConvTranspose", "Einsum", "Attention")
INTEGER = ("MatMulIntegerToFloat", "MatMulInteger", "ConvInteger", "DynamicQuantizeMatMul")
EIGHT_BITS = (2, 3)  # onnx.TensorProto: uint8, int8
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


class QuantizedGraph(OnnxGraph):
    """The nodes of an ONNX file, seen from its int8 layers."""

    def __init__(self, name: str, path: Path) -> None:
        super().__init__(require("onnx", "build").load(str(path), load_external_data=False))
        self.name, self.nodes = name, list(self.graph.node)

    def layers(self) -> list[str]:
        """Return the names of the layers that are int8 in the file."""
        return [node.name for node in self.nodes if node.op_type in INTEGER or self._paired(node)]

    def pairs(self) -> tuple[int, int]:
        """Return how many values are quantized, and how many are dequantized, at run time."""
        first = sum(node.op_type in QUANTIZERS for node in self.nodes)
        return first, sum(self._activation(node) for node in self.nodes)

    def islands(self) -> list[Island]:
        """Return the round trips: int8 -> float -> int8 with nothing but light operators in between."""
        return [island for node in self.nodes if self._activation(node) for island in self._ways(node)]

    def asymmetric(self) -> list[str]:
        """Return the quantizers of activations with a zero point other than 0."""
        quantizers = [node for node in self.nodes if node.op_type == "QuantizeLinear" and len(node.input) > 2]
        return [node.name for node in quantizers if node.input[2] in self.constants and self._offset(node.input[2])]

    def _offset(self, zero: str) -> bool:
        tensor = self.constants[zero]
        return tensor.data_type in EIGHT_BITS and not tensor.dims and bool(self.array(zero))

    def _activation(self, node: Any) -> bool:
        return node.op_type == "DequantizeLinear" and node.input[0] not in self.constants

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
        islands = []
        pending: list[tuple[str, tuple[Any, ...]]] = [(start.output[0], ())]
        while pending:
            value, way = pending.pop()
            for reader in self.readers[value]:
                if reader.op_type in QUANTIZERS:
                    names = tuple(node.name for node in (start, *way, reader))
                    kinds = tuple(node.op_type for node in way)
                    islands.append(Island(self.name, start.name, kinds, reader.name, names))
                elif reader.op_type not in (*COMPUTING, *INTEGER) and len(way) < LONGEST:
                    pending.append((reader.output[0], (*way, reader)))
        return islands


def timed(islands: Iterable[Island], operators: Sequence[Operator]) -> list[Island]:
    """Return the islands with what their nodes cost in the profile, the dearest first."""
    spent: Counter[tuple[str, str]] = Counter()
    for operator in operators:
        spent[operator.graph, operator.name] += operator.ms  # type: ignore[assignment]
    costs = [replace(island, ms=sum(spent[island.graph, name] for name in island.nodes)) for island in islands]
    return sorted(costs, key=lambda island: -island.ms)


def fallbacks(graph: QuantizedGraph, operators: Sequence[Operator], engine: str) -> list[Fallback]:
    """Return the int8 layers of a file that the engine did not run as fast int8 kernels, the dearest first."""
    own = [operator for operator in operators if operator.graph == graph.name]
    fallen = [*_in_float(graph, own), *_weights(graph, own), *_slow(graph, own, engine_class(engine))]
    return sorted(fallen, key=lambda fallback: -fallback.ms)


def _in_float(graph: QuantizedGraph, operators: Sequence[Operator]) -> Iterator[Fallback]:
    """Yield layers that are int8 in the file and a float product in the profile."""
    layers = set(graph.layers())
    why = "int8 in the file, computed in float: the engine did not fuse its quantize-dequantize pairs"
    for operator in operators:
        name = operator.name
        layer = next((known for known in (name, name.partition("/MatMul")[0]) if known in layers), "")
        layer = layer or next((known for known in layers if name.startswith((f"{known}/", f"{known}_token_"))), "")
        if operator.product and operator.precision == FLOAT32 and layer:
            yield Fallback(graph.name, layer, why, operator.ms)


def _weights(graph: QuantizedGraph, operators: Sequence[Operator]) -> Iterator[Fallback]:
    """Yield weights that are dequantized at every inference."""
    quantized = [node for node in graph.nodes if node.op_type == "DequantizeLinear" and not graph._activation(node)]
    stored = {node.name: node.output[0] for node in quantized}
    for operator in operators:
        if operator.kind == "DequantizeLinear" and operator.name in stored:
            readers = graph.readers[stored[operator.name]]
            layer = readers[0].name if readers else operator.name
            yield Fallback(graph.name, layer, "its int8 weight is dequantized to float at every inference", operator.ms)


def _slow(graph: QuantizedGraph, operators: Sequence[Operator], library: type[Engine]) -> Iterator[Fallback]:
    """Yield int8 nodes that do not run as the engine's fast kernels, as it says itself."""
    zero_points = len(graph.asymmetric())
    for operator in operators:
        why = library.slow(operator.node, operator.precision, operator.product, zero_points)
        if why:
            yield Fallback(graph.name, operator.name, why, operator.ms)
