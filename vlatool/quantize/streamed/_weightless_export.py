"""Export of a policy's ONNX graphs without loading the weights, which stay in their shards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.errors import GraphError, SourceError, require
from vlatool.module.fake_weights import as_float32, run_on_fake_tensors
from vlatool.module.sharded_weights import StoredModules, policy_weights, stored_modules
from vlatool.module.to_onnx import exported_by_torch, name_by_module, quiet_exporter, strip_notes
from vlatool.weights.shards import FLOATS, StoredTensor, stored_array

FOLD_LIMIT = 1 << 16
"""Largest constants to fold, in elements."""


@dataclass(frozen=True)
class GraphTemplate:
    """A graph without the values of its large constants.

    Args:
        model: An ``onnx_ir.Model`` whose initializers have shapes and dtypes, and values only when they are small.
        tensors: Initializer -> location of its bytes.
    """

    model: Any
    tensors: dict[str, StoredTensor]
    opset: int


def export_templates(bundle: Bundle, opset: int) -> dict[str, GraphTemplate]:
    """Export every graph of a source bundle without reading a weight: graph name -> template.

    The factory is called once, with every parameter on torch's meta device as soon as it is registered; buffers are
    computed. The export then runs under ``FakeTensorMode``.

    Raises:
        SourceError: when code has changed, the factory fails, or shards and modules do not match.
        GraphError: when torch cannot export a module.
    """
    for package in ("torch", "onnx", "onnxscript"):
        require(package, "build")
    stored = stored_modules(bundle)
    _check_dtypes(stored)
    modules, file = as_float32(stored.modules), policy_weights(bundle)[0] / "policy.yaml"
    exported: dict[str, tuple[Any, dict[str, Any]]] = {}

    def visit(step: ProgramStep, module: Any, feeds: list[Any], real: dict[str, Any]) -> None:
        if step.graph not in exported:
            exported[step.graph] = (exported_by_torch(module, feeds, step, opset, optimize=False).model, real)

    run_on_fake_tensors(bundle, modules, visit)
    at = stored.locations
    return {name: _template(model, at[name], real, opset, file) for name, (model, real) in exported.items()}


def _check_dtypes(stored: StoredModules) -> None:
    for graph, module in stored.modules.items():
        for name, value in module.state_dict(keep_vars=True).items():
            tensor = stored.locations[graph][name]
            if value.is_floating_point() and tensor.dtype not in FLOATS:
                raise SourceError(
                    f"'{tensor.name}' in {tensor.file.name} is {tensor.dtype}; weights may be F32, F16 or BF16.",
                    "convert the shards (weights that are quantized already cannot be quantized again)",
                )


def _template(
    model: Any, weights: dict[str, StoredTensor], real: dict[str, Any], opset: int, file: Path
) -> GraphTemplate:
    """Give initializers their values or their location in a shard, then fold small constants."""
    import onnx_ir
    import onnxscript.optimizer

    tensors: dict[str, StoredTensor] = {}
    for name, value in model.graph.initializers.items():
        if name in weights:
            tensors[name] = weights[name]
            value.const_value = None
        elif name in real:
            value.const_value = onnx_ir.tensor(real[name].detach().cpu().numpy(), name=name)
        elif type(value.const_value.raw).__name__ == "FakeTensor" if hasattr(value.const_value, "raw") else False:
            raise GraphError(
                f"The value of the constant '{name}' is unknown: it was created during the export of the graph.",
                "create it in the module's __init__ and register it as a buffer",
            )
    with quiet_exporter():
        onnxscript.optimizer.optimize_ir(model, input_size_limit=FOLD_LIMIT, output_size_limit=FOLD_LIMIT)
    name_by_module(model)
    strip_notes(model)
    kept = {}
    for name, value in model.graph.initializers.items():
        if value.const_value is None:
            kept[name] = tensors[name]
        else:
            kept[name] = stored_array(name, value.const_value.numpy(), file)
    return GraphTemplate(model, kept, opset)
