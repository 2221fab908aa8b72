"""Run a graph node by node on several samples at once, one weight in memory at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError, require
from vlatool.quantize._compute import as_float32, stored_bytes
from vlatool.quantize._fake_export import Skeleton
from vlatool.quantize._records import Tools
from vlatool.quantize._rewrite import Layer

Array = NDArray[Any]
Values = dict[str, Array]
Product = Callable[[Layer, Array, Tools], Array]
"""Layer, activations (rows, K) of all samples, tools -> products (rows, N)."""


class Layerwise:
    """One graph on several samples.

    Args:
        skeleton: The graph before it is changed.
        layers: Its products with weights that are quantized; ``product`` computes them.
        product: Called for each such layer, in the order of the graph.
    """

    def __init__(self, skeleton: Skeleton, layers: list[Layer], product: Product) -> None:
        self._skeleton = skeleton
        self._layers = {id(layer.node): layer for layer in layers}
        self._product = product
        self._sessions: dict[Any, Any] = {}

    def run(self, samples: list[Values], tools: Tools) -> Iterator[None]:
        """Run all nodes, yielding before each; inputs are taken from ``samples`` and outputs put there, by name.

        Raises:
            GraphError: when ONNX Runtime cannot run a node alone.
        """
        graph = self._skeleton.model.graph
        outputs = {value.name for value in graph.outputs}
        waiting = Counter(value.name for node in graph for value in node.inputs if value is not None)
        for node in graph:
            yield
            if self._is_turned_weight(node):
                continue
            layer = self._layers.get(id(node))
            if layer is not None:
                self._multiply(layer, samples, tools)
            else:
                constants = self._constants(node, samples[0], tools)
                session, names = self._session(node, {**samples[0], **constants})
                for values in samples:
                    feeds = {name: {**values, **constants}[name] for name in names}
                    given = session.run(None, feeds)
                    used = [output.name for output in node.outputs if output.name]
                    values.update(zip(used, given, strict=True))
            for value in node.inputs:
                if value is not None:
                    waiting[value.name] -= 1
                    if not waiting[value.name] and value.name not in outputs:
                        for values in samples:
                            values.pop(value.name, None)

    def _is_turned_weight(self, node: Any) -> bool:
        readers = [reader for output in node.outputs for reader in output.consumers()]
        return node.op_type == "Transpose" and bool(readers) and all(id(each) in self._layers for each in readers)

    def _multiply(self, layer: Layer, samples: list[Values], tools: Tools) -> None:
        name, out = layer.node.inputs[0].name, layer.node.outputs[0].name
        activations = [np.ascontiguousarray(values[name], np.float32) for values in samples]
        rows = np.concatenate([each.reshape(-1, layer.rows) for each in activations])
        products = self._product(layer, rows, tools)
        if layer.bias is not None:
            bias = {**samples[0], **self._constants(layer.node, samples[0], tools, skip=1)}[layer.bias.name]
            products = products + bias
        begin = 0
        for values, each in zip(samples, activations, strict=True):
            count = each.size // layer.rows
            values[out] = products[begin : begin + count].reshape(*each.shape[:-1], layer.columns)
            begin += count

    def _constants(self, node: Any, given: Values, tools: Tools, skip: int | None = None) -> Values:
        """Return the constants that a node reads, as the graph wants them."""
        found = {}
        for number, value in enumerate(node.inputs):
            if value is None or value.name in given or number == skip or not value.is_initializer():
                continue
            tensor = self._skeleton.tensors.get(value.name)
            if tensor is None:
                found[value.name] = value.const_value.numpy()
                continue
            raw = stored_bytes(tensor, tools)
            if tensor.dtype in ("F16", "BF16", "F32"):
                found[value.name] = as_float32(raw, tensor.dtype).reshape(tensor.shape)
            else:
                found[value.name] = raw.view(value.dtype.numpy()).reshape(tensor.shape)
        return found

    def _session(self, node: Any, values: Values) -> tuple[Any, list[str]]:
        """Return a session of that node alone and the names of what it is fed, in the order of its inputs."""
        import onnx
        import onnx_ir

        names = [value.name if value is not None else "" for value in node.inputs]
        kinds = tuple(str(values[name].dtype) if name else "" for name in names)
        proto = onnx_ir.to_proto(node)
        attributes = tuple(sorted(each.SerializeToString() for each in proto.attribute))
        key = (node.op_type, node.domain, kinds, attributes, len(node.outputs), tuple(_first(names)))
        if key not in self._sessions:
            self._sessions[key] = _open(onnx, proto, names, values, self._skeleton.model)
        session, inputs, slots = self._sessions[key]
        return _Renamed(session, inputs, [names[slot] for slot in slots]), [names[slot] for slot in slots]


def _first(names: list[str]) -> list[int]:
    """Number each name by its first place, so that a repeated input is told from two inputs."""
    return [names.index(name) for name in names]


class _Renamed:
    """A session whose inputs go by another node's names."""

    def __init__(self, session: Any, inputs: list[str], names: list[str]) -> None:
        self._session, self._names = session, dict(zip(names, inputs, strict=True))

    def run(self, outputs: None, feeds: Values) -> list[Array]:
        """Run the node."""
        given: list[Array] = self._session.run(outputs, {self._names[name]: value for name, value in feeds.items()})
        return given


def _open(onnx: Any, proto: Any, names: list[str], values: Values, model: Any) -> tuple[Any, list[str], list[int]]:
    ort = require("onnxruntime", "ort")
    helper = onnx.helper
    slots = [number for number, name in enumerate(names) if name and names.index(name) == number]
    inputs = [
        helper.make_tensor_value_info(names[slot], helper.np_dtype_to_tensor_dtype(values[names[slot]].dtype), None)
        for slot in slots
    ]
    outputs = [onnx.ValueInfoProto(name=name) for name in proto.output if name]
    opsets = [helper.make_opsetid(domain, version) for domain, version in model.graph.opset_imports.items()]
    graph = helper.make_graph([proto], "node", inputs, outputs)
    single = helper.make_model(graph, opset_imports=opsets, ir_version=10)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(single.SerializeToString(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
        raise GraphError(
            f"ONNX Runtime cannot run the node '{proto.name}' ({proto.op_type}) alone: {str(error).splitlines()[0]}.",
            "use --method rtn or hqq, which need no activations",
        ) from error
    return session, [names[slot] for slot in slots], slots
