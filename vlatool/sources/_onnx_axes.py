"""Free axes of an ONNX file: the batch is 1, the others are what the description says; and its opset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import SourceError, require

INFERRED_BYTES = 1_500_000_000
"""Above this protobuf cannot hand a model to the inference of shapes."""


def fix_axes(model: Any, spec: PolicySpec | None) -> dict[str, dict[int, int]]:
    """Give the free axes of a model's inputs their lengths, in place: input -> axis -> length.

    An axis has the length that the spec gives; else the first one is the batch, which is 1. An axis that is named like
    one of these has that length too. What depends on them is inferred again.

    Args:
        model: A ``ModelProto``.
        spec: Of the description; None where the file describes itself.
    """
    inputs = _inputs(model)
    names = {value.name for value in inputs}
    named: dict[str, int] = {}
    fixed: dict[str, dict[int, int]] = {}
    for value in inputs:
        declared = _declared(value.name, spec)
        for place, axis in enumerate(_axes(value)):
            length = declared.get(place, 1 if place == 0 and spec is None else 0)
            if not _is_free(axis, place) or length < 1:
                continue
            if axis.dim_param:
                named.setdefault(axis.dim_param, length)
            axis.dim_value = fixed.setdefault(value.name, {})[place] = length
    for value in (*inputs, *model.graph.value_info, *model.graph.output):
        for place, axis in enumerate(_axes(value)):
            if axis.dim_param in named:
                axis.dim_value = named[axis.dim_param]
                if value.name in names:
                    fixed.setdefault(value.name, {})[place] = axis.dim_value
            elif _is_free(axis, place) and not axis.dim_param:  # -1 is no length
                axis.Clear()
    if fixed and model.ByteSize() < INFERRED_BYTES:
        _infer(model)
    return fixed


def axes_text(fixed: Mapping[str, Mapping[int, int]]) -> str:
    """Return which axes were fixed, in words; empty for none."""
    lengths = [f"{name} axis {place} = {length}" for name, axes in fixed.items() for place, length in axes.items()]
    return f"free axes get a length: {', '.join(lengths)}" if lengths else ""


def with_opset(model: Any, opset: int) -> Any:
    """Return a model in another opset of the default domain.

    Raises:
        SourceError: when onnx cannot convert it; says why.
    """
    converter = require("onnx.version_converter", "build")
    now = opset_of(model)
    if now == opset:
        return model
    try:
        return converter.convert_version(model, opset)
    except Exception as error:  # the seam: the converter raises many foreign types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise SourceError(
            f"The ONNX file has opset {now}, which onnx cannot convert to {opset}: {reason}.",
            f"leave --opset out, or export the file again with opset {opset} where it was made",
        ) from error


def opset_of(model: Any) -> int:
    """Return the opset of the default domain, 0 when there is none."""
    return max((entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")), default=0)


def _inputs(model: Any) -> list[Any]:
    stored = {tensor.name for tensor in model.graph.initializer}
    return [value for value in model.graph.input if value.name not in stored]


def _axes(value: Any) -> Any:
    return value.type.tensor_type.shape.dim


def _is_free(axis: Any, place: int) -> bool:
    """Return whether an axis has no length: some exporters write -1, and 0 for the batch."""
    return not axis.HasField("dim_value") or axis.dim_value < (1 if place == 0 else 0)


def _declared(name: str, spec: PolicySpec | None) -> dict[int, int]:
    tensor = next((entry for entry in spec.inputs if entry.name == name), None) if spec else None
    return {place: axis for place, axis in enumerate(tensor.shape if tensor else ()) if isinstance(axis, int)}


def _infer(model: Any) -> None:
    """Infer the shapes that follow; what cannot be inferred stays as it is declared."""
    onnx = require("onnx", "build")
    try:
        inferred = onnx.shape_inference.infer_shapes(model, data_prop=True)
    except Exception:  # the seam: a model that onnx cannot infer may still run
        return
    outputs = {value.name: value for value in inferred.graph.output}
    for value in model.graph.output:
        axes = _axes(outputs[value.name])
        if len(axes) and math.prod(axis.dim_value for axis in axes) > 0:
            value.CopyFrom(outputs[value.name])
    del model.graph.value_info[:]
    model.graph.value_info.extend(inferred.graph.value_info)
