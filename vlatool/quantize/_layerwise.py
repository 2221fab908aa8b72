"""Run a graph node by node on several samples at once, one weight in memory at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError
from vlatool.quantize._compute import as_float32, stored_bytes
from vlatool.quantize._fake_export import Skeleton
from vlatool.quantize._records import Tools
from vlatool.quantize._rewrite import Layer, read_as_weight, turns_constant
from vlatool.runtime.engines import node_session

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
        waiting = Counter(value.name for node in graph for value in _values(node))
        for node in graph:
            yield
            if self._is_turned_weight(node):
                continue
            layer = self._layers.get(id(node))
            if layer is not None:
                self._multiply(layer, samples, tools)
            else:
                self._run_node(node, samples, tools)
            for value in _values(node):
                waiting[value.name] -= 1
                if not waiting[value.name] and value.name not in outputs:
                    for values in samples:
                        values.pop(value.name, None)
        constants = self._constants(graph.outputs, samples[0], tools)
        for values in samples:
            values.update(constants)

    def _run_node(self, node: Any, samples: list[Values], tools: Tools) -> None:
        constants = self._constants(_values(node), samples[0], tools)
        session, names = self._session(node, {**samples[0], **constants})
        used = [output.name for output in node.outputs if output.name]
        for values in samples:
            feeds = {name: {**values, **constants}[name] for name in names}
            try:
                given = session.run(None, feeds)
            except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
                raise _refused(node.name, node.op_type, error) from error
            values.update(zip(used, given, strict=True))

    def _is_turned_weight(self, node: Any) -> bool:
        uses = [use for output in node.outputs for use in output.uses()]
        return turns_constant(node) and bool(uses) and all(read_as_weight(use, self._layers) for use in uses)

    def _multiply(self, layer: Layer, samples: list[Values], tools: Tools) -> None:
        name, out = layer.node.inputs[0].name, layer.node.outputs[0].name
        activations = [np.ascontiguousarray(values[name], np.float32) for values in samples]
        rows = np.concatenate([each.reshape(-1, layer.rows) for each in activations])
        products = self._product(layer, rows, tools)
        biases = [layer.bias] if layer.bias is not None else []
        constants = self._constants(biases, samples[0], tools)
        begin = 0
        for values, each in zip(samples, activations, strict=True):
            count = each.size // layer.rows
            made = products[begin : begin + count].reshape(*each.shape[:-1], layer.columns)
            for bias in biases:
                made = made + {**values, **constants}[bias.name]
            values[out] = made
            begin += count

    def _constants(self, wanted: Iterable[Any], given: Values, tools: Tools) -> Values:
        """Return those of some values that are constants, as the graph wants them."""
        found = {}
        for value in wanted:
            if value.name in given or not value.is_initializer():
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

        own = [value.name if value is not None else "" for value in node.inputs]
        taken = [value.name for value in _values(node)[len([name for name in own if name]) :]]
        names = own + taken
        kinds = tuple(str(getattr(values[name], "dtype", type(values[name]))) if name else "" for name in names)
        proto = onnx_ir.to_proto(node)
        attributes = tuple(sorted(each.SerializeToString() for each in proto.attribute))
        given = tuple(bool(output.name) for output in node.outputs)
        key = (node.op_type, node.domain, kinds, attributes, given, tuple(_first(names)), tuple(taken))
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
    slots = [number for number, name in enumerate(names) if name and names.index(name) == number]
    try:
        single = _single(onnx, proto, {names[slot]: values[names[slot]].dtype for slot in slots}, model)
        session = node_session(single.SerializeToString())
    except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
        raise _refused(proto.name, proto.op_type, error) from error
    return session, [names[slot] for slot in slots], slots


def _single(onnx: Any, proto: Any, dtypes: dict[str, Any], model: Any) -> Any:
    """Return a model of one node that reads values of those dtypes, of any shape."""
    helper = onnx.helper
    inputs = [
        helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(dtype), None)
        for name, dtype in dtypes.items()
    ]
    outputs = [onnx.ValueInfoProto(name=name) for name in proto.output if name]
    opsets = [helper.make_opsetid(domain, version) for domain, version in model.graph.opset_imports.items()]
    graph = helper.make_graph([proto], "node", inputs, outputs)
    return helper.make_model(graph, opset_imports=opsets, ir_version=10)


def _refused(name: str, kind: str, error: Exception) -> GraphError:
    reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
    return GraphError(
        f"ONNX Runtime cannot run the node '{name}' ({kind}) alone: {reason}.",
        "use --method rtn or hqq, which need no activations",
    )


def _values(node: Any) -> list[Any]:
    """Return the values that a node reads, and those that the graphs inside it (If, Loop, Scan) take from outside."""
    return [value for value in node.inputs if value is not None] + list(_taken(node).values())


def _taken(node: Any) -> dict[str, Any]:
    """Return name -> value that the graphs inside a node take from outside."""
    found: dict[str, Any] = {}
    for attribute in node.attributes.values():
        if attribute.type.name not in ("GRAPH", "GRAPHS"):
            continue
        for graph in [attribute.value] if attribute.type.name == "GRAPH" else attribute.value:
            inside = {*graph.inputs, *graph.initializers.values(), *(out for each in graph for out in each.outputs)}
            read = [*graph.outputs, *(value for each in graph for value in _values(each))]
            found.update({value.name: value for value in read if value not in inside})
    return found
