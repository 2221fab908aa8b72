"""A float32 graph in which a separate input switches each layer to int8.

Each layer becomes an ``If`` on a boolean scalar: one branch quantizes and dequantizes the inputs of the layer, as the
int8 graph does, the other is the original float layer. One session then serves all combinations of layers, and the
constants of the branch that is not taken cost nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError
from vlatool.graph.files import load
from vlatool.graph.layers import Layer, Style, calibrated_values, hoisted_values
from vlatool.graph.onnx_graph import FLOAT, OnnxGraph
from vlatool.graph.qdq import Range, insert_qdq

FLAG_PREFIX = "int8."
"""Prefix of the name of the input that switches a layer."""


def add_switches(
    path: Path, layers: Iterable[Layer], ranges: Mapping[str, Range] | None, style: Style
) -> tuple[Any, dict[str, str]]:
    """Return the graph with switches, and layer name -> name of its boolean input of shape ().

    Args:
        path: A float32 ONNX file.
        layers: Layers from ``find_layers`` of that file.
        ranges: Value name -> (low, high), for every value of ``calibrated_values``; when None, ranges are computed at
            run time (uint8, DynamicQuantizeLinear).
    """
    selected = list(layers)
    quantized = load(path)
    hoisted = hoisted_values(quantized, selected, style)
    plain = replace(style, hoist=False)
    known: dict[str, Range] = {}
    for name in calibrated_values(selected, plain, {}):
        source = hoisted.get(name, name)
        if ranges is not None and source not in ranges:
            raise GraphError(f"The value '{source}' of {path.name} has no range.", "calibrate with the same stage")
        known[name] = (0.0, 1.0) if ranges is None else ranges[source]
    insert_qdq(quantized, selected, known, plain)
    pairs = _Pairs(quantized, dynamic=ranges is None)
    model = load(path)
    return model, _Writer(model, {layer.name: layer for layer in selected}, pairs, plain).write()


class _Pairs(OnnxGraph):
    """Copies of the quantize-dequantize nodes of an int8 graph."""

    def __init__(self, model: Any, *, dynamic: bool) -> None:
        super().__init__(model)
        self.dynamic = dynamic
        self.nodes = {node.name: node for node in model.graph.node}
        self.used: dict[str, Any] = {}

    def input_pair(self, layer: str, index: int, source: str, suffix: str) -> tuple[list[Any], str]:
        """Return the nodes before an input of a layer, and the name of their output; none for an unquantized input.

        Args:
            source: Input of the copied QuantizeLinear.
            suffix: Suffix that makes the names of the copies unique.
        """
        node = self.nodes[layer]
        last = self.producers.get(node.input[index])
        if last is None or last.op_type != "DequantizeLinear":
            return [], ""
        first = self.producers.get(last.input[0])
        if first is not None and first.op_type == "QuantizeLinear":
            return self._pair(first, last, source, suffix)
        self._use(last.input)
        copy = self._copy(last, list(last.input), f"{last.output[0]}{suffix}")
        return [copy], copy.output[0]

    def output_pair(self, name: str, suffix: str) -> tuple[list[Any], str]:
        """Return the pair that quantizes the output of a convolution, and the name of its output."""
        first = next(node for node in self.readers[name] if node.op_type == "QuantizeLinear")
        return self._pair(first, self.readers[first.output[0]][0], name, suffix)

    def _pair(self, first: Any, last: Any, source: str, suffix: str) -> tuple[list[Any], str]:
        middle, end = f"{first.output[0]}{suffix}", f"{last.output[0]}{suffix}"
        if self.dynamic:
            parts = [middle, f"{middle}.scale", f"{middle}.zero"]
            return [
                self.node("DynamicQuantizeLinear", [source], parts),
                self.node("DequantizeLinear", parts, [end]),
            ], end
        self._use((*first.input[1:], *last.input[1:]))
        quantize = self._copy(first, [source, *first.input[1:]], middle)
        return [quantize, self._copy(last, [middle, *last.input[1:]], end)], end

    def _copy(self, node: Any, inputs: list[str], output: str) -> Any:
        copy = self.node(node.op_type, inputs, [output], f"{node.name}@{output}")
        copy.attribute.extend(node.attribute)
        return copy

    def _use(self, names: Iterable[str]) -> None:
        self.used.update({name: self.constants[name] for name in names})


class _Writer(OnnxGraph):
    def __init__(self, model: Any, layers: Mapping[str, Layer], pairs: _Pairs, style: Style) -> None:
        super().__init__(model)
        self.layers, self.pairs = layers, pairs
        self.nodes: list[Any] = []
        self.rerouted: dict[str, str] = {}
        self.flags = {name: f"{FLAG_PREFIX}{number}" for number, name in enumerate(layers)}
        convolutions = [layer for layer in layers.values() if layer.kind == "Conv" and style.fused_convolutions]
        self.fused = {layer.output: layer for layer in convolutions if layer.output not in self.outputs}

    def write(self) -> dict[str, str]:
        """Rebuild the list of nodes; return layer name -> flag."""
        for node in self.graph.node:
            node.input[:] = [self.rerouted.get(name, name) for name in node.input]
            self.nodes.append(self._as_if(node) if node.name in self.layers else node)
            if node.output[0] in self.fused:
                self._switch_output(self.fused[node.output[0]])
        self.replace_nodes(self.nodes)
        self.graph.initializer.extend(self.pairs.used.values())
        info, boolean = self.onnx.helper.make_tensor_value_info, self.onnx.TensorProto.BOOL
        self.graph.input.extend(info(flag, boolean, []) for flag in self.flags.values())
        return dict(self.flags)

    def _as_if(self, node: Any) -> Any:
        """Return the layer as an ``If``."""
        flag = self.flags[node.name]
        before: list[Any] = []
        inputs = list(node.input)
        for index, name in enumerate(node.input):
            nodes, value = self.pairs.input_pair(node.name, index, name, f"@{flag}.{index}")
            before += nodes
            inputs[index] = value or name
        return self._if(flag, node, inputs, before)

    def _switch_output(self, layer: Layer) -> None:
        """Redirect all later readers of a convolution's output to the switched output."""
        flag, target = self.flags[layer.name], f"{layer.output}@switched"
        before, value = self.pairs.output_pair(layer.output, f"@{flag}.out")
        node = self.node("Identity", [layer.output], [target], f"{layer.name}@out")
        self.nodes.append(self._if(flag, node, [value], before))
        self.rerouted[layer.output] = target

    def _if(self, flag: str, node: Any, inputs: list[str], before: list[Any]) -> Any:
        """Return an ``If``: ``before`` and the node on ``inputs`` when the flag is set, else the node alone."""
        helper = self.onnx.helper
        branches = {}
        for word, nodes, read in (("then", before, inputs), ("else", [], list(node.input))):
            output = f"{node.output[0]}@{word}"
            last = self.node(node.op_type, read, [output], f"{node.name}@{word}", domain=node.domain)
            last.attribute.extend(node.attribute)
            value = helper.make_tensor_value_info(output, FLOAT, None)
            branches[f"{word}_branch"] = helper.make_graph([*nodes, last], f"{node.name}@{word}", [], [value])
        return self.node("If", [flag], [node.output[0]], node.name, **branches)
