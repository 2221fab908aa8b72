"""Run a graph node by node on several samples, one weight in memory at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from vlatool.errors import GraphError
from vlatool.quantize.streamed._graph_rewrite import Product, is_weight_use, transposes_constant
from vlatool.quantize.streamed._weightless_export import GraphTemplate
from vlatool.quantize.streamed.records import Tools
from vlatool.quantize.streamed.tensor_jobs import as_float32, read_bytes
from vlatool.runtime.engines import node_session
from vlatool.runtime.interface import Array
from vlatool.weights.shards import FLOATS

Values = dict[str, Array]
Multiply = Callable[[Product, Array, Tools], Array]
"""Product, activations (rows, K) of all samples, tools -> products (rows, N)."""


class LayerExecutor:
    """One graph on several samples.

    Args:
        template: The graph before its rewrite.
        products: Products whose weights are quantized.
        multiply: Function that computes each of them, in the order of the graph.
    """

    def __init__(self, template: GraphTemplate, products: list[Product], multiply: Multiply) -> None:
        self._template = template
        self._products = {id(product.node): product for product in products}
        self._compute = multiply
        self._sessions: dict[Any, Any] = {}

    def run(self, samples: list[Values], tools: Tools) -> Iterator[None]:
        """Run all nodes, yielding before each; ``samples`` hold the inputs and receive the outputs, by name."""
        graph = self._template.model.graph
        outputs = {value.name for value in graph.outputs}
        pending_reads = Counter(value.name for node in graph for value in _read_values(node))
        for node in graph:
            yield
            if self._is_transposed_weight(node):
                continue
            product = self._products.get(id(node))
            if product is not None:
                self._multiply(product, samples, tools)
            else:
                self._run_node(node, samples, tools)
            for value in _read_values(node):
                pending_reads[value.name] -= 1
                if not pending_reads[value.name] and value.name not in outputs:
                    for values in samples:
                        values.pop(value.name, None)
        constants = self._constants(graph.outputs, samples[0], tools)
        for values in samples:
            values.update(constants)

    def _run_node(self, node: Any, samples: list[Values], tools: Tools) -> None:
        constants = self._constants(_read_values(node), samples[0], tools)
        session, inputs = self._session(node, {**samples[0], **constants})
        used = [output.name for output in node.outputs if output.name]
        for values in samples:
            feeds = {own: {**values, **constants}[name] for own, name in inputs.items()}
            try:
                outputs = session.run(None, feeds)
            except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
                raise _run_error(node.name, node.op_type, error) from error
            values.update(zip(used, outputs, strict=True))

    def _is_transposed_weight(self, node: Any) -> bool:
        uses = [use for output in node.outputs for use in output.uses()]
        return transposes_constant(node) and bool(uses) and all(is_weight_use(use, self._products) for use in uses)

    def _multiply(self, product: Product, samples: list[Values], tools: Tools) -> None:
        name, out, bias = product.node.inputs[0].name, product.node.outputs[0].name, product.bias
        activations = [np.ascontiguousarray(values[name], np.float32) for values in samples]
        rows = np.concatenate([array.reshape(-1, product.rows) for array in activations])
        ends = np.cumsum([array.size // product.rows for array in activations])
        outputs = np.split(self._compute(product, rows, tools), ends[:-1])
        constants = self._constants([bias] if bias is not None else [], samples[0], tools)
        for values, array, output in zip(samples, activations, outputs, strict=True):
            values[out] = output.reshape(*array.shape[:-1], product.columns)
            if bias is not None:
                values[out] = values[out] + {**values, **constants}[bias.name]

    def _constants(self, needed: Iterable[Any], known: Values, tools: Tools) -> Values:
        """Return the constants among some values, in the dtypes of the graph."""
        constants = {}
        for value in needed:
            if value.name in known or not value.is_initializer():
                continue
            tensor = self._template.tensors.get(value.name)
            if tensor is None:
                constants[value.name] = value.const_value.numpy()
                continue
            raw = read_bytes(tensor, tools)
            flat = as_float32(raw, tensor.dtype) if tensor.dtype in FLOATS else raw.view(value.dtype.numpy())
            constants[value.name] = flat.reshape(tensor.shape)
        return constants

    def _session(self, node: Any, values: Values) -> tuple[Any, dict[str, str]]:
        """Return a session for nodes like this one, and its inputs -> names of the values to feed."""
        import onnx_ir

        declared = [value.name if value is not None else "" for value in node.inputs]
        outer = [value.name for value in _read_values(node)[len(list(filter(None, declared))) :]]
        names = declared + outer
        kinds = tuple(str(getattr(values[name], "dtype", type(values[name]))) if name else "" for name in names)
        proto = onnx_ir.to_proto(node)
        attributes = tuple(sorted(attribute.SerializeToString() for attribute in proto.attribute))
        outputs = tuple(bool(output.name) for output in node.outputs)
        firsts = tuple(names.index(name) for name in names)  # a repeated input is not two inputs
        key = (node.op_type, node.domain, kinds, attributes, outputs, firsts, tuple(outer))
        if key not in self._sessions:
            inputs = {name: values[name].dtype for name in names if name}
            self._sessions[key] = _node_session(proto, inputs, self._template.model), list(inputs)
        session, inputs = self._sessions[key]
        return session, dict(zip(inputs, dict.fromkeys(filter(None, names)), strict=True))


def _node_session(proto: Any, dtypes: dict[str, Any], model: Any) -> Any:
    import onnx

    try:
        return node_session(_single_node_model(onnx, proto, dtypes, model).SerializeToString())
    except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
        raise _run_error(proto.name, proto.op_type, error) from error


def _single_node_model(onnx: Any, proto: Any, dtypes: dict[str, Any], model: Any) -> Any:
    """Return a model of a single node with inputs of these dtypes and any shape."""
    helper = onnx.helper
    inputs = [
        helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(dtype), None)
        for name, dtype in dtypes.items()
    ]
    outputs = [onnx.ValueInfoProto(name=name) for name in proto.output if name]
    opsets = [helper.make_opsetid(domain, version) for domain, version in model.graph.opset_imports.items()]
    graph = helper.make_graph([proto], "node", inputs, outputs)
    return helper.make_model(graph, opset_imports=opsets, ir_version=10)


def _run_error(name: str, kind: str, error: Exception) -> GraphError:
    reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
    return GraphError(
        f"ONNX Runtime cannot run the node '{name}' ({kind}) alone: {reason}.",
        "use --method rtn or hqq, which need no activations",
    )


def _read_values(node: Any) -> list[Any]:
    """Return the values that a node reads, and those that its subgraphs (If, Loop, Scan) capture."""
    return [value for value in node.inputs if value is not None] + list(_outer_values(node).values())


def _outer_values(node: Any) -> dict[str, Any]:
    """Return name -> value that the subgraphs of a node capture from outside."""
    outer: dict[str, Any] = {}
    for attribute in node.attributes.values():
        if attribute.type.name not in ("GRAPH", "GRAPHS"):
            continue
        for graph in [attribute.value] if attribute.type.name == "GRAPH" else attribute.value:
            inside = {*graph.inputs, *graph.initializers.values(), *(out for inner in graph for out in inner.outputs)}
            read = [*graph.outputs, *(value for inner in graph for value in _read_values(inner))]
            outer.update({value.name: value for value in read if value not in inside})
    return outer
