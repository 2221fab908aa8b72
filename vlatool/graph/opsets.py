"""ONNX models in an older opset or IR version, for engines that take no newer one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlatool.errors import GraphError, require
from vlatool.files.printable import message_of, one_line
from vlatool.graph.files import save
from vlatool.graph.nodes import with_inner_nodes
from vlatool.graph.onnx_graph import DOMAINS, OnnxGraph, type_name

NEEDS_IR = {17: 9, 18: 9, 19: 9, 20: 9, 21: 10, 22: 10, 23: 11, 24: 12}
"""``TensorProto.DataType`` -> first IR version that has it: float8, int4, float4, float8 of scales."""

NEWER_FORMS = 18
"""Opset from which axes of reductions are an input and Split has the number of its parts."""


def opset_of(model: Any) -> int:
    """Return the opset of the default domain, 0 when there is none."""
    return max((entry.version for entry in model.opset_import if entry.domain in DOMAINS), default=0)


def fit_versions(model: Any, opset: int | None, ir_version: int | None) -> Any:
    """Return an ``onnx.ModelProto`` whose opset and IR version are at most these; itself where they are already.

    Raises:
        GraphError: when an operator or a type cannot be written so, by its name.
    """
    if opset is not None and opset_of(model) > opset:
        model = _lowered(model, opset)
    if ir_version is not None and model.ir_version > ir_version:
        _refuse_types(model, ir_version)
        model.ir_version = ir_version
    return model


def fit_file(path: Path, opset: int | None, ir_version: int | None) -> int:
    """Fit a file as ``fit_versions`` does, in place; return its opset."""
    onnx = require("onnx", "build")
    light = onnx.load(str(path), load_external_data=False)
    beyond = (opset is not None and opset_of(light) > opset) or (ir_version or light.ir_version) < light.ir_version
    if not beyond:
        return opset_of(light)
    fitted = fit_versions(onnx.load(str(path)), opset, ir_version)
    save(fitted, path)
    return opset_of(fitted)


def _lowered(model: Any, opset: int) -> Any:
    """Return a model in a lower opset: by onnx's converter, or unchanged but for the number where that is valid.

    The converter lacks adapters for operators whose newer versions only take more types.
    """
    onnx = require("onnx", "build")
    converter = require("onnx.version_converter", "build")
    known = {entry.domain for entry in model.opset_import} <= set(DOMAINS)
    try:
        if known and model.ByteSize() < onnx.checker.MAXIMUM_PROTOBUF:
            lowered = converter.convert_version(model, opset)
            onnx.checker.check_model(lowered, full_check=True)
            return lowered
    except Exception:  # the seam: the converter raises many foreign types; the number alone may do
        pass
    before = opset_of(model)
    lowered = onnx.ModelProto()
    lowered.CopyFrom(model)
    for entry in lowered.opset_import:
        if entry.domain in DOMAINS:
            entry.version = opset
    if opset < NEWER_FORMS:
        _write_older_forms(lowered)
    try:
        onnx.checker.check_model(lowered, full_check=lowered.ByteSize() < onnx.checker.MAXIMUM_PROTOBUF)
    except Exception as error:
        reason = one_line(message_of(error), 200)
        raise GraphError(
            f"The graph has opset {before} and cannot be written in opset {opset}: "
            f"{_changed_text(model, before, opset) or reason}.",
            "export the policy itself in that opset (vlatool export POLICY --opset N), or update the engine",
        ) from error
    return lowered


def _write_older_forms(model: Any) -> None:
    """Write constant axes of reductions as attributes, and splits into equal parts without their number, in place."""
    graph = OnnxGraph(model)
    held = {name: graph.array(name) for name in graph.constants if len(graph.constants[name].dims) < 2}
    held |= {node.output[0]: graph.onnx.numpy_helper.to_array(node.attribute[0].t) for node in model.graph.node
             if node.op_type == "Constant" and node.attribute[0].name == "value"}  # fmt: skip
    for node in model.graph.node:
        if node.op_type.startswith("Reduce") and node.op_type != "ReduceSum" and len(node.input) > 1:
            if node.input[1] in held:
                axes = [int(axis) for axis in held[node.input[1]].reshape(-1)]
                _drop_attribute(node, "noop_with_empty_axes")
                node.attribute.append(graph.onnx.helper.make_attribute("axes", axes))
                del node.input[1:]
        elif node.op_type == "Split" and len(node.input) == 1:
            _drop_attribute(node, "num_outputs")
    graph.drop_unread_constants()


def _drop_attribute(node: Any, name: str) -> None:
    kept = [item for item in node.attribute if item.name != name]
    del node.attribute[:]
    node.attribute.extend(kept)


def _changed_text(model: Any, before: int, opset: int) -> str:
    """Return the operators that the lower opset lacks; those that are another version there, where it lacks none."""
    defs = require("onnx.defs", "build")
    absent, changed = dict[str, None](), dict[str, None]()
    for node in with_inner_nodes(model.graph.node):
        if node.domain not in DOMAINS:
            continue
        try:
            old, new = (defs.get_schema(node.op_type, version).since_version for version in (opset, before))
        except defs.SchemaError:
            absent[node.op_type] = None
            continue
        if old != new:
            changed[node.op_type] = None
    names = ", ".join(absent or changed)
    return f"it has {names}, which came or changed after that" if names else ""


def _refuse_types(model: Any, ir_version: int) -> None:
    types = {tensor.data_type for tensor in model.graph.initializer}
    types |= {value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)}
    newer = sorted(type_name(kind) for kind in types if NEEDS_IR.get(kind, 0) > ir_version)
    if newer:
        raise GraphError(
            f"The graph holds {', '.join(newer)}, which IR version {ir_version} lacks.",
            "use a bundle in another precision, or update the engine",
        )
