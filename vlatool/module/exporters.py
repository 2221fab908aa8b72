"""Exporters of torch modules, in the order in which they are tried: none of them takes every policy."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vlatool.bundle.program import ProgramStep
from vlatool.errors import GraphError, SourceError, require
from vlatool.module.factory import map_user_exceptions
from vlatool.module.failures import export_error
from vlatool.module.recorded_forward import record_forward
from vlatool.module.to_onnx import NAME_SCOPES, quiet_exporter, raise_interrupt, translate

if TYPE_CHECKING:
    from torch import nn

LEGACY_OPSET = 20
"""Highest opset of torch's exporter of TorchScript."""
Translated = tuple[Any, Any]
"""An ``onnx_ir.Model``, and the ``torch.export.ExportedProgram`` that it was made from; None where there is none."""
Exporter = Callable[["nn.Module", Sequence[Any], ProgramStep, int], Translated]


def dynamo(module: nn.Module, arguments: Sequence[Any], step: ProgramStep, opset: int) -> Translated:
    """Translate what torch.export makes of the whole module."""
    exported = translate(module, arguments, step, opset)
    return exported.model, exported.exported_program


def split(module: nn.Module, arguments: Sequence[Any], step: ProgramStep, opset: int) -> Translated:
    """Record what ``forward()`` does between its parts, and let dynamo translate these."""
    recorded = _run(lambda: record_forward(module, arguments, step.graph), step, module)
    return dynamo(recorded, arguments, step, opset)


def legacy(module: nn.Module, arguments: Sequence[Any], step: ProgramStep, opset: int) -> Translated:
    """Let torch's older exporter trace and translate the module."""
    torch, onnx, ir = require("torch", "build"), require("onnx", "build"), require("onnx_ir", "build")
    stream = io.BytesIO()
    _run(
        lambda: torch.onnx.export(
            module, tuple(arguments), stream, dynamo=False, opset_version=min(opset, LEGACY_OPSET),
            input_names=list(step.feeds), output_names=list(step.gives),
        ),
        step, module,
    )  # fmt: skip
    model = ir.from_proto(onnx.load_from_string(stream.getvalue()))
    require("onnxscript.optimizer", "build").optimize(model)
    if opset > LEGACY_OPSET:
        require("onnxscript.version_converter", "build").convert_version(model, opset)
    _name_ends(model, arguments, step)
    for node in model.graph.all_nodes():
        _note_module(node, _legacy_module(node.name or ""))
    return model, None


def trace(module: nn.Module, arguments: Sequence[Any], step: ProgramStep, opset: int) -> Translated:
    """Trace the module, and translate the trace as dynamo's programs are."""
    torch = require("torch", "build")
    converter = require("torch._export.converter", "build").TS2EPConverter

    def program() -> Any:
        traced = torch.jit.trace(module, tuple(arguments), check_trace=False, strict=False)
        return converter(traced, tuple(arguments)).convert().module()

    exported = translate(_run(program, step, module), arguments, step, opset)
    for node in exported.model.graph.all_nodes():
        names = [value.name for value in node.inputs if value is not None and value.is_initializer()]
        _note_module(node, next((name.rpartition(".")[0] for name in names if name.endswith(".weight")), ""))
    return exported.model, exported.exported_program


EXPORTERS: Mapping[str, Exporter] = {"dynamo": dynamo, "split": split, "legacy": legacy, "trace": trace}


def _run(function: Callable[[], Any], step: ProgramStep, module: nn.Module) -> Any:
    """Run a part of an export, quietly.

    Raises:
        GraphError: when it fails.
    """
    try:
        with quiet_exporter(), require("torch", "build").no_grad(), map_user_exceptions("the policy's forward()"):
            return function()
    except (GraphError, SourceError):
        raise
    except Exception as error:  # the seam: exporters raise many foreign types
        raise_interrupt(error)
        raise export_error(error, step.graph, module) from error


def _name_ends(model: Any, arguments: Sequence[Any], step: ProgramStep) -> None:
    """Give a graph the inputs that nothing in it reads, which the exporter left out, and its outputs their names."""
    ir = require("onnx_ir", "build")
    held = {value.name: value for value in model.graph.inputs}
    for name, tensor in zip(step.feeds, arguments, strict=True):
        kind = ir.TensorType(ir.DataType.from_numpy(tensor.numpy().dtype))
        held.setdefault(name, ir.Value(name=name, shape=ir.Shape(tuple(tensor.shape)), type=kind))
    model.graph.inputs[:] = [held[name] for name in step.feeds]
    for number, (value, name) in enumerate(zip(model.graph.outputs, step.gives, strict=True)):
        if value.name != name:
            node = ir.node("Identity", [value])
            node.outputs[0].name, node.outputs[0].shape, node.outputs[0].type = name, value.shape, value.type
            model.graph.append(node)
            model.graph.outputs[number] = node.outputs[0]


def _legacy_module(name: str) -> str:
    """Return the path of the module that a node of torch's older exporter is named after.

    Example:
        >>> _legacy_module("/inner/net/net.0/Gemm")
        'inner.net.0'
    """
    parts: list[str] = []
    for part in name.strip("/").split("/")[:-1]:
        parts = [*parts[:-1], part] if parts and part.startswith(f"{parts[-1]}.") else [*parts, part]
    return ".".join(parts)


def _note_module(node: Any, path: str) -> None:
    """Note the module of a node where dynamo would."""
    if path:
        node.metadata_props[NAME_SCOPES] = repr(["", path, node.op_type])
