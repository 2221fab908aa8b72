"""What other tools write, as the stages read it: constants as initializers that are not inputs, in one graph."""

from __future__ import annotations

import copy
from collections import Counter
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.graph.gemm_factors import FACTORS, extract_gemm_factors
from vlatool.graph.nodes import name_nodes, read_names, reads

MOVERS = ("Identity", "Cast", "Transpose", "Reshape", "Flatten", "Squeeze", "Unsqueeze", "Split")
"""Operators through which exporters let a weight go on its way to a layer."""
MIN_TIED_BYTES = 1 << 20
"""Bytes of a weight above which it stays one where it is read in two ways, as a tied embedding is."""
LATER_IR = 4
"""Version of the file format from which initializers need not be inputs."""


def plain(model: Any) -> Any:
    """Return a model with the same outputs whose weights are initializers, and that has no local functions.

    What depends on nothing but constants, and moves or casts them, is done here: a product whose weight is a node is
    not a layer to what quantizes or counts.

    Args:
        model: A ``ModelProto`` with its weights, changed in place where it can be.
    """
    if model.functions:
        model = require("onnx.inliner", "build").inline_local_functions(model)
    graph = model.graph
    _fill_sparse(graph)
    stored = {tensor.name: tensor for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in stored]
    if len(inputs) < len(graph.input):
        del graph.input[:]
        graph.input.extend(inputs)
    model.ir_version = max(model.ir_version, LATER_IR)
    given = {value.name for value in graph.output}
    readers = Counter(name for node in graph.node for name in set(reads(node)))
    nodes = []
    for node in graph.node:
        tied = any(
            readers[name] > 1 and stored[name].ByteSize() > MIN_TIED_BYTES for name in node.input if name in stored
        )
        made = {} if tied or given.intersection(node.output) else _made(model, node, stored)
        for name, tensor in made.items():
            graph.initializer.append(tensor)
            stored[name] = graph.initializer[-1]
        if not made:
            nodes.append(node)
    nodes = copy.deepcopy(nodes)
    del graph.node[:]
    graph.node.extend(nodes)
    _drop_unread(graph)
    name_nodes(model)
    scaled = any(item.name in FACTORS for node in graph.node if node.op_type == "Gemm" for item in node.attribute)
    return _with_plain_gemms(model) if scaled else model


def _fill_sparse(graph: Any) -> None:
    """Write sparse weights, stored or in Constant nodes, as tensors with all their zeros."""
    for sparse in graph.sparse_initializer:
        graph.initializer.append(_dense(sparse))
    del graph.sparse_initializer[:]
    for node in graph.node:
        for item in node.attribute:
            if node.op_type == "Constant" and item.name == "sparse_value":
                dense = _dense(item.sparse_tensor)
                node.attribute.remove(item)
                node.attribute.append(require("onnx", "build").helper.make_attribute("value", dense))


def _dense(sparse: Any) -> Any:
    """Return a sparse tensor as one with all values; its indices count all values, or name a place on each axis."""
    helper = require("onnx", "build").numpy_helper
    values, places = helper.to_array(sparse.values), helper.to_array(sparse.indices)
    full = np.zeros(tuple(sparse.dims), values.dtype)
    full[np.unravel_index(places, full.shape) if places.ndim == 1 else tuple(places.T)] = values
    return helper.from_array(full, sparse.values.name)


def _with_plain_gemms(model: Any) -> Any:
    ir = require("onnx_ir", "build")
    changed = ir.from_proto(model)
    return ir.to_proto(changed) if extract_gemm_factors(changed) else model


def _drop_unread(graph: Any) -> None:
    """Remove the weights that no node reads and that are not outputs: what was moved would be stored twice."""
    read = read_names(graph.node) | {value.name for value in graph.output}
    for index in reversed(range(len(graph.initializer))):
        if graph.initializer[index].name not in read:
            del graph.initializer[index]


def _made(model: Any, node: Any, stored: dict[str, Any]) -> dict[str, Any]:
    """Return the constants that a node makes of constants; none where it does something else."""
    if node.domain not in ("", "ai.onnx"):
        return {}
    held = next((item.t for item in node.attribute if item.name == "value"), None)
    if node.op_type == "Constant" and held is not None:
        tensor = copy.deepcopy(held)
        tensor.name = node.output[0]
        return {tensor.name: tensor}
    constant = node.op_type == "Constant" or (node.op_type in MOVERS and node.input)
    if not constant or not all(name in stored for name in node.input if name):
        return {}
    return _evaluated(model, node, [stored[name] for name in node.input if name])


def _evaluated(model: Any, node: Any, constants: list[Any]) -> dict[str, Any]:
    onnx = require("onnx", "build")
    reference, helper = require("onnx.reference", "build"), onnx.helper
    outputs = [onnx.ValueInfoProto(name=name) for name in node.output if name]
    alone = helper.make_model(
        helper.make_graph([node], "constant", [], outputs, constants),
        opset_imports=model.opset_import, ir_version=model.ir_version,
    )  # fmt: skip
    try:
        values = reference.ReferenceEvaluator(alone).run(None, {})
        return {
            value.name: onnx.numpy_helper.from_array(array, value.name)
            for value, array in zip(outputs, values, strict=True)
        }
    except Exception:  # the seam: what onnx cannot compute stays a node
        return {}
