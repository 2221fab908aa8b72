"""A float32 graph in which every layer can be switched to int8 by an input of its own.

Each layer becomes an ``If`` on a boolean scalar: one branch quantizes and dequantizes what the layer reads, as the int8
graph does, the other is the float layer as it was. One session then serves all choices of layers, and the constants of
the branch that is not taken cost nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlatool.errors import GraphError, require
from vlatool.graph.files import load
from vlatool.graph.layers import Layer, Style, calibrated_values, hoisted
from vlatool.graph.qdq import Range, insert_qdq

FLAG = "int8."
"""Prefix of the name of the input that switches a layer."""


def add_switches(
    path: Path, layers: Iterable[Layer], ranges: Mapping[str, Range] | None, style: Style
) -> tuple[Any, dict[str, str]]:
    """Return the graph with its switches, and layer name -> name of the boolean input of shape () that switches it.

    Args:
        path: A float32 ONNX file.
        layers: From ``find_layers`` of that file.
        ranges: Value name -> (low, high), of every value that ``calibrated_values`` names; when None, ranges are taken
            from the values at run time (uint8, DynamicQuantizeLinear).
        style: How the int8 graph writes its layers.

    Raises:
        GraphError: when a range is missing, or a weight holds NaN or infinity.
    """
    chosen = list(layers)
    written = load(path)
    moved = hoisted(written, chosen, style)
    plain = replace(style, hoist=False)
    known: dict[str, Range] = {}
    for name in calibrated_values(chosen, plain, {}):
        source = moved.get(name, name)
        if ranges is not None and source not in ranges:
            raise GraphError(
                f"There is no range for the value '{source}' of {path.name}.", "calibrate with the same stage"
            )
        known[name] = (0.0, 1.0) if ranges is None else ranges[source]
    insert_qdq(written, chosen, known, plain)
    pairs = _Pairs(written, dynamic=ranges is None)
    model = load(path)
    return model, _Writer(model, {layer.name: layer for layer in chosen}, pairs, plain).write()


class _Pairs:
    """The quantize-dequantize nodes of an int8 graph, copied to where they are wanted."""

    def __init__(self, model: Any, *, dynamic: bool) -> None:
        self.onnx = require("onnx", "build")
        self.dynamic = dynamic
        self.producers = {name: node for node in model.graph.node for name in node.output}
        self.nodes = {node.name: node for node in model.graph.node}
        self.quantizers = {node.input[0]: node for node in model.graph.node if node.op_type == "QuantizeLinear"}
        self.tensors = {tensor.name: tensor for tensor in model.graph.initializer}
        self.used: dict[str, Any] = {}

    def of_input(self, layer: str, index: int, source: str, suffix: str) -> tuple[list[Any], str]:
        """Return the nodes before an input of a layer, and the name they give; none when it is read as it is.

        Args:
            layer: Name of the node.
            index: Which of its inputs.
            source: What the copied QuantizeLinear reads.
            suffix: Makes the names of the copies unique.
        """
        node = self.nodes[layer]
        last = self.producers.get(node.input[index])
        if last is None or last.op_type != "DequantizeLinear":
            return [], ""
        first = self.producers.get(last.input[0])
        if first is not None and first.op_type == "QuantizeLinear":
            return self._pair(first, last, source, suffix)
        self._use(last.input)
        made = self._copy(last, list(last.input), f"{last.output[0]}{suffix}")
        return [made], made.output[0]

    def of_output(self, name: str, suffix: str) -> tuple[list[Any], str]:
        """Return the pair that quantizes what a convolution gives, and the name it gives."""
        first = self.quantizers[name]
        last = next(node for node in self.producers.values() if first.output[0] in node.input)
        return self._pair(first, last, name, suffix)

    def _pair(self, first: Any, last: Any, source: str, suffix: str) -> tuple[list[Any], str]:
        middle, given = f"{first.output[0]}{suffix}", f"{last.output[0]}{suffix}"
        if self.dynamic:
            made = self.onnx.helper.make_node
            parts = [middle, f"{middle}.scale", f"{middle}.zero"]
            return [made("DynamicQuantizeLinear", [source], parts), made("DequantizeLinear", parts, [given])], given
        self._use((*first.input[1:], *last.input[1:]))
        quantize = self._copy(first, [source, *first.input[1:]], middle)
        return [quantize, self._copy(last, [middle, *last.input[1:]], given)], given

    def _copy(self, node: Any, inputs: list[str], output: str) -> Any:
        made = self.onnx.helper.make_node(node.op_type, inputs, [output], name=f"{node.name}@{output}")
        made.attribute.extend(node.attribute)
        return made

    def _use(self, names: Iterable[str]) -> None:
        self.used.update({name: self.tensors[name] for name in names})


@dataclass
class _Writer:
    model: Any
    layers: Mapping[str, Layer]
    pairs: _Pairs
    style: Style
    nodes: list[Any] = field(default_factory=list)
    rerouted: dict[str, str] = field(default_factory=dict)
    flags: dict[str, str] = field(default_factory=dict)

    def write(self) -> dict[str, str]:
        """Rebuild the list of nodes; return layer name -> flag."""
        onnx, graph = require("onnx", "build"), self.model.graph
        outputs = {value.name for value in graph.output}
        self.flags = {name: f"{FLAG}{number}" for number, name in enumerate(self.layers)}
        convolutions = {
            layer.output: layer
            for layer in self.layers.values()
            if layer.kind == "Conv" and self.style.fused_convolutions and layer.output not in outputs
        }
        for node in graph.node:
            for index, name in enumerate(node.input):
                node.input[index] = self.rerouted.get(name, name)
            self.nodes.append(self._switched(node) if node.name in self.layers else node)
            layer = convolutions.get(node.output[0])
            if layer is not None:
                self._output(layer)
        del graph.node[:]
        graph.node.extend(self.nodes)
        graph.initializer.extend(self.pairs.used.values())
        boolean = onnx.TensorProto.BOOL
        graph.input.extend(onnx.helper.make_tensor_value_info(flag, boolean, []) for flag in self.flags.values())
        return dict(self.flags)

    def _switched(self, node: Any) -> Any:
        """Return the layer as an ``If``."""
        flag = self.flags[node.name]
        before: list[Any] = []
        inputs = list(node.input)
        for index, name in enumerate(node.input):
            made, given = self.pairs.of_input(node.name, index, name, f"@{flag}.{index}")
            before += made
            inputs[index] = given or name
        return self._if(flag, node, inputs, before)

    def _output(self, layer: Layer) -> None:
        """Let all later readers of a convolution's output read what its flag makes of it."""
        onnx = require("onnx", "build")
        flag, target = self.flags[layer.name], f"{layer.output}@switched"
        before, given = self.pairs.of_output(layer.output, f"@{flag}.out")
        node = onnx.helper.make_node("Identity", [layer.output], [target], name=f"{layer.name}@out")
        self.nodes.append(self._if(flag, node, [given], before))
        self.rerouted[layer.output] = target

    def _if(self, flag: str, node: Any, inputs: list[str], before: list[Any]) -> Any:
        """Return an ``If``: ``before`` and the node on ``inputs`` when the flag is set, else the node alone."""
        helper = require("onnx", "build").helper
        branches = {}
        for word, nodes, read in (("then", before, inputs), ("else", [], list(node.input))):
            given = f"{node.output[0]}@{word}"
            last = helper.make_node(node.op_type, read, [given], name=f"{node.name}@{word}", domain=node.domain)
            last.attribute.extend(node.attribute)
            value = helper.make_tensor_value_info(given, 1, None)
            branches[f"{word}_branch"] = helper.make_graph([*nodes, last], f"{node.name}@{word}", [], [value])
        return helper.make_node("If", [flag], [node.output[0]], name=node.name, **branches)
