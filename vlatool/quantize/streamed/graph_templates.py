"""Graphs of a bundle with the location of each constant, as input of streamed quantization."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, SourceError, VlatoolError, require
from vlatool.graph.nodes import name_each
from vlatool.module.sharded_weights import policy_weights, takes_shards
from vlatool.quantize.streamed._graph_rewrite import MAX_INLINE_BYTES
from vlatool.quantize.streamed._weightless_export import GraphTemplate, export_templates
from vlatool.quantize.streamed.tensor_jobs import as_float32
from vlatool.weights.shards import FLOATS, NUMPY_NAMES, Reader, StoredTensor, fingerprint, shard_files, stored_array

BLOCKED_OPSET = 21
"""First opset whose DequantizeLinear supports blocks and int4."""


def load_templates(bundle: Bundle, opset: int) -> dict[str, GraphTemplate]:
    """Return graph name -> template, from a bundle's ONNX files or from its policy's shards.

    Raises:
        SourceError: when there is neither a graph nor a description of the shards.
        GraphError: when a graph holds a constant of an unknown dtype outside the file.
    """
    if bundle.manifest.graphs:
        return {name: _read_template(bundle.file(graph.file)) for name, graph in bundle.manifest.graphs.items()}
    if not takes_shards(bundle):
        raise SourceError(
            f"The policy {bundle.manifest.name} does not specify which shards hold its weights.",
            "add 'weights: \"*.safetensors\"' to policy.yaml (see docs/concepts/large-models.md), or export it first",
        )
    templates = export_templates(bundle, opset)
    for template in templates.values():
        _read_small_constants(template)
    return templates


def weights_fingerprint(bundle: Bundle) -> str:
    """Return a fingerprint of the weights outside the bundle; empty for a bundle with graphs."""
    if bundle.manifest.graphs:
        return ""
    return fingerprint(shard_files(*policy_weights(bundle)))


def _read_template(path: Path) -> GraphTemplate:
    ir = require("onnx_ir", "build")
    try:
        model = ir.load(str(path))
        name_each(list(model.graph))
        stored = {name: _tensor_location(ir, name, value, path) for name, value in model.graph.initializers.items()}
        tensors = {name: tensor for name, tensor in stored.items() if tensor is not None}
    except VlatoolError:
        raise
    except Exception as error:  # the seam: protobuf and onnx_ir raise many foreign types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise GraphError(
            f"{path} cannot be read as ONNX: {reason}", "check that the file is whole, or export the policy again"
        ) from error
    return GraphTemplate(model, tensors, int(model.graph.opset_imports.get("", 0)))


def _tensor_location(ir: Any, name: str, value: Any, path: Path) -> StoredTensor | None:
    """Return the location of a constant; None when it stays in the graph, as shapes must."""
    tensor = value.const_value
    external = isinstance(tensor, ir.ExternalTensor)
    if tensor is None:
        return None
    kind = NUMPY_NAMES.get({"FLOAT": "float32", "DOUBLE": "float64"}.get(tensor.dtype.name, tensor.dtype.name.lower()))
    shape = tuple(int(axis) for axis in tensor.shape)
    small = tensor.nbytes <= MAX_INLINE_BYTES and not (kind in FLOATS and len(shape) == 2)
    if small or kind is None:
        if external and not small:
            raise GraphError(
                f"{path} holds '{name}' as {tensor.dtype.name} outside the file, which cannot be streamed.",
                "export the policy again in float32, float16 or bfloat16",
            )
        if external:
            value.const_value = ir.tensor(tensor.numpy().copy(), name=name)
        return None
    if external:
        return StoredTensor(name, Path(tensor.path), int(tensor.offset or 0), kind, shape)
    return stored_array(name, tensor.numpy(), path)


def _read_small_constants(template: GraphTemplate) -> None:
    """Load the values of constants that stay in the graph."""
    import onnx_ir

    with Reader() as reader:
        for name, tensor in list(template.tensors.items()):
            small = tensor.count * 4 <= MAX_INLINE_BYTES
            if not small or (len(tensor.shape) == 2 and tensor.dtype in FLOATS):
                continue
            if tensor.array is None:
                wide = as_float32(reader.read(tensor, 0, tensor.nbytes), tensor.dtype).reshape(tensor.shape)
                template.model.graph.initializers[name].const_value = onnx_ir.tensor(wide.copy(), name=name)
            del template.tensors[name]
