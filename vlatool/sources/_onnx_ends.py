"""Inputs and outputs of an ONNX file that a spec cannot say, and outputs whose shape only a run knows."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.bundle.spec import DTYPES, PolicySpec, TensorSpec
from vlatool.data import random_observations
from vlatool.errors import SourceError
from vlatool.graph.files import save
from vlatool.graph.onnx_graph import type_name
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.engine import engine_class
from vlatool.runtime.observation import ObservationEncoder

LENGTHS = (1, 2)
"""Of the free axes of inputs, in runs on different inputs; an axis of an output that has one length in all of them is
taken to have it always."""
ZIPMAP = "a classifier of skl2onnx is converted with options={'zipmap': False}"


def refuse_types(model: Any, described: bool) -> None:
    """Refuse what is not a tensor, or of a type that numpy lacks; bfloat16 is not refused.

    An output that is not a tensor, and not the first, is left out where there is a description, which cannot name it.

    Raises:
        SourceError: naming the value, its type, and what helps.
    """
    for value in [*model.graph.output][1:]:
        if described and value.type.WhichOneof("value") != "tensor_type":
            model.graph.output.remove(value)
    for values, what in ((model.graph.input, "input"), (model.graph.output, "output")):
        for value in values:
            name = _type_of(value)
            if name not in (*DTYPES, "bfloat16"):
                remedy = f"; {ZIPMAP}" if name.startswith(("sequence", "map")) and what == "output" else ""
                raise SourceError(
                    f"The {what} '{value.name}' has the type {name}; allowed: tensors of {', '.join(DTYPES)}.",
                    f"let the file {'take' if what == 'input' else 'give'} such tensors where it is made{remedy}",
                )


def _type_of(value: Any) -> str:
    kind = value.type.WhichOneof("value") or "no type"
    if kind != "tensor_type":
        return str(kind).removesuffix("_type").replace("_", " ")
    return type_name(value.type.tensor_type.elem_type)


def complete_outputs(model: Any, path: Path, inputs: Sequence[TensorSpec]) -> None:
    """Give outputs the axes that the file does not say, in place, as runs on drawn inputs show them.

    An axis that is named as a free one of an input stays free.

    Args:
        model: A ``ModelProto``; its inputs have shapes.

    Raises:
        GraphError: when ONNX Runtime refuses it, or fails.
    """
    free = {axis for tensor in inputs for axis in tensor.shape if isinstance(axis, str)}
    unknown = [value for value in model.graph.output if not _is_said(value, free)]
    if not unknown:
        return
    save(model, path)
    with engine_call(engine_class(), f"ran {path.name}"):
        session = engine_class()(path, threads=1)
        runs = [session.run(_drawn(inputs, length)) for length in LENGTHS]
    for value in unknown:
        shapes = [tuple(run[value.name].shape) for run in runs]
        _put_axes(value.type.tensor_type.shape, shapes, free)


def _drawn(inputs: Sequence[TensorSpec], length: int) -> dict[str, Any]:
    fixed = [
        replace(each, shape=tuple(length if isinstance(axis, str) else axis for axis in each.shape)) for each in inputs
    ]
    spec = PolicySpec(tuple(fixed), (TensorSpec("action of a file", (1, 1)),), 1)
    return ObservationEncoder(spec, Path())(random_observations(spec, 1, seed=length)[0])


def _is_said(value: Any, free: Set[str]) -> bool:
    shape = value.type.tensor_type
    return bool(shape.HasField("shape")) and all(
        axis.dim_param in free or axis.HasField("dim_value") for axis in shape.shape.dim
    )


def _put_axes(shape: Any, seen: list[tuple[int, ...]], free: Set[str]) -> None:
    if not shape.dim:
        for _ in seen[0]:
            shape.dim.add()
    shape.SetInParent()
    for axis, lengths in zip(shape.dim, zip(*seen, strict=True), strict=True):
        if axis.dim_param not in free and not axis.HasField("dim_value") and len(set(lengths)) == 1:
            axis.dim_value = lengths[0]
