"""Losses of a quantized graph between its int8 layers: round trips through float, and layers that fell back."""

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
COMPUTE_OPS = ("MatMul", "Gemm", "Conv", "ConvTranspose", "Einsum", "Attention")
INTEGER_OPS = ("MatMulIntegerToFloat", "MatMulInteger", "ConvInteger", "DynamicQuantizeMatMul")
EIGHT_BIT_TYPES = (2, 3)  # onnx.TensorProto: uint8, int8
MAX_BETWEEN = 4
"""Largest number of operators between DequantizeLinear and QuantizeLinear in a round trip."""


@dataclass(frozen=True)
class RoundTrip:
    """A value that is dequantized, computed in float by a few light operators, and quantized again.

    Args:
        start: Name of the DequantizeLinear.
        between: Operator types in between; empty when QuantizeLinear follows directly.
        end: Name of the QuantizeLinear.
        nodes: Names of all its nodes.
        ms: Time of nodes with these names in the profile of one inference; 0 when the engine fused them.
    """

    graph: str
    start: str
    between: tuple[str, ...]
    end: str
    nodes: tuple[str, ...]
    ms: float = 0.0


@dataclass(frozen=True)
class Fallback:
    """A layer that is int8 in the file but runs as no fast int8 kernel, and its cost: ``ms`` in one inference."""

    graph: str
    layer: str
    why: str
    ms: float


class QuantizedGraph(OnnxGraph):
    """A quantized ONNX file: its int8 layers and the conversions between them."""

    def __init__(self, name: str, path: Path) -> None:
        super().__init__(require("onnx", "build").load(str(path), load_external_data=False))
        self.name, self.nodes = name, list(self.graph.node)

    def layers(self) -> list[str]:
        """Return the names of the layers that are int8 in the file."""
        return [node.name for node in self.nodes if node.op_type in INTEGER_OPS or self._has_quantized_operands(node)]

    def pairs(self) -> tuple[int, int]:
        """Return the numbers of values that are quantized, and dequantized, at run time."""
        first = sum(node.op_type in QUANTIZERS for node in self.nodes)
        return first, sum(self._is_dequantizer(node) for node in self.nodes)

    def round_trips(self) -> list[RoundTrip]:
        """Return the round trips: int8 -> float -> int8 with only light operators in between."""
        return [trip for node in self.nodes if self._is_dequantizer(node) for trip in self._trips_from(node)]

    def asymmetric(self) -> list[str]:
        """Return the quantizers of activations with a zero point other than 0."""
        quantizers = [node for node in self.nodes if node.op_type == "QuantizeLinear" and len(node.input) > 2]
        return [node.name for node in quantizers if node.input[2] in self.constants and self._has_offset(node.input[2])]

    def _has_offset(self, zero: str) -> bool:
        tensor = self.constants[zero]
        return tensor.data_type in EIGHT_BIT_TYPES and not tensor.dims and bool(self.array(zero))

    def _is_dequantizer(self, node: Any) -> bool:
        return node.op_type == "DequantizeLinear" and node.input[0] not in self.constants

    def _has_quantized_operands(self, node: Any) -> bool:
        """Return whether both operands of a float layer are dequantized, possibly moved afterwards."""
        if node.op_type not in COMPUTE_OPS or len(node.input) < 2:
            return False
        sources = [self._source(name) for name in node.input[:2]]
        return all(source is not None and source.op_type == "DequantizeLinear" for source in sources)

    def _source(self, value: str) -> Any:
        """Return the node that produced a value, before any moves; None for an input or a constant."""
        node = self.producers.get(value)
        while node is not None and node.op_type in (*MOVES, "MaxPool"):
            node = self.producers.get(node.input[0])
        return node

    def _trips_from(self, start: Any) -> list[RoundTrip]:
        """Follow a dequantized value to each QuantizeLinear that it reaches without a heavy layer in between."""
        trips = []
        pending: list[tuple[str, tuple[Any, ...]]] = [(start.output[0], ())]
        while pending:
            value, path = pending.pop()
            for reader in self.readers[value]:
                if reader.op_type in QUANTIZERS:
                    names = tuple(node.name for node in (start, *path, reader))
                    kinds = tuple(node.op_type for node in path)
                    trips.append(RoundTrip(self.name, start.name, kinds, reader.name, names))
                elif reader.op_type not in (*COMPUTE_OPS, *INTEGER_OPS) and len(path) < MAX_BETWEEN:
                    pending.append((reader.output[0], (*path, reader)))
        return trips


def with_times(trips: Iterable[RoundTrip], operators: Sequence[Operator]) -> list[RoundTrip]:
    """Return the round trips with the times of their nodes in the profile, the most expensive first."""
    spent: Counter[tuple[str, str]] = Counter()
    for operator in operators:
        spent[operator.graph, operator.name] += operator.ms  # type: ignore[assignment]
    costs = [replace(trip, ms=sum(spent[trip.graph, name] for name in trip.nodes)) for trip in trips]
    return sorted(costs, key=lambda trip: -trip.ms)


def fallbacks(graph: QuantizedGraph, operators: Sequence[Operator], engine: str) -> list[Fallback]:
    """Return the int8 layers of a file that the engine did not run as fast int8 kernels, the most expensive first."""
    own = [operator for operator in operators if operator.graph == graph.name]
    slow = _slow_fallbacks(graph, own, engine_class(engine))
    found = [*_float_fallbacks(graph, own), *_weight_fallbacks(graph, own), *slow]
    return sorted(found, key=lambda fallback: -fallback.ms)


def _float_fallbacks(graph: QuantizedGraph, operators: Sequence[Operator]) -> Iterator[Fallback]:
    """Yield layers that are int8 in the file but a float product in the profile."""
    layers = set(graph.layers())
    why = "int8 in the file, computed in float: the engine did not fuse its quantize-dequantize pairs"
    for operator in operators:
        name = operator.name
        layer = next((known for known in (name, name.partition("/MatMul")[0]) if known in layers), "")
        layer = layer or next((known for known in layers if name.startswith((f"{known}/", f"{known}_token_"))), "")
        if operator.product and operator.precision == FLOAT32 and layer:
            yield Fallback(graph.name, layer, why, operator.ms)


def _weight_fallbacks(graph: QuantizedGraph, operators: Sequence[Operator]) -> Iterator[Fallback]:
    """Yield weights that are dequantized at every inference."""
    quantized = [node for node in graph.nodes if node.op_type == "DequantizeLinear" and not graph._is_dequantizer(node)]
    stored = {node.name: node.output[0] for node in quantized}
    for operator in operators:
        if operator.kind == "DequantizeLinear" and operator.name in stored:
            readers = graph.readers[stored[operator.name]]
            layer = readers[0].name if readers else operator.name
            yield Fallback(graph.name, layer, "its int8 weight is dequantized to float at every inference", operator.ms)


def _slow_fallbacks(graph: QuantizedGraph, operators: Sequence[Operator], library: type[Engine]) -> Iterator[Fallback]:
    """Yield int8 nodes that do not run as fast kernels according to the engine."""
    zero_points = len(graph.asymmetric())
    for operator in operators:
        why = library.slow(operator.node, operator.precision, operator.product, zero_points)
        if why:
            yield Fallback(graph.name, operator.name, why, operator.ms)
