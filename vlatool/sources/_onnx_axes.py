"""Free axes of an ONNX file: the batch is 1, the others are what the description says; and its opset."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from typing import Any

from vlatool.errors import SourceError, require
from vlatool.graph.opsets import opset_of

Shapes = Mapping[str, tuple[int | str, ...]]
INFERRED_BYTES = 1_500_000_000
"""Above this protobuf cannot hand a model to the inference of shapes."""


def fix_axes(model: Any, shapes: Shapes, described: bool, file: str = "FILE.onnx") -> dict[str, dict[int, int]]:
    """Give the free axes of a model's inputs their lengths, in place: input -> axis -> length.

    An axis has the length that is given; else the first one is the batch, which is 1. An axis that is named like one of
    these has that length too. What depends on them is inferred again.

    Args:
        shapes: Input -> axes: lengths, and names of axes that stay free.
        described: Whether they are those of a description, which knows all inputs; where it has none, they are those
            that a person gave beside the file.

    Raises:
        SourceError: where a shape that was given does not fit the file, or an axis other than the first is free and
            nobody gave it a length.
    """
    inputs = _inputs(model)
    if not described:
        _check_given(inputs, shapes)
    names = {value.name for value in inputs}
    named: dict[str, int] = {}
    fixed: dict[str, dict[int, int]] = {}
    for value in inputs:
        _put_rank(value, shapes.get(value.name))
        declared = dict(enumerate(shapes.get(value.name, ())))
        for index, axis in enumerate(_axes(value)):
            length = declared.get(index, 1 if index == 0 and not described else 0)
            if isinstance(length, str):
                if _is_free(axis, index):
                    axis.dim_param = length
                continue
            if not _is_free(axis, index) or length < 1:
                continue
            if axis.dim_param:
                named.setdefault(axis.dim_param, length)
            axis.dim_value = fixed.setdefault(value.name, {})[index] = length
    for value in (*inputs, *model.graph.value_info, *model.graph.output):
        for index, axis in enumerate(_axes(value)):
            if axis.dim_param in named:
                axis.dim_value = named[axis.dim_param]
                if value.name in names:
                    fixed.setdefault(value.name, {})[index] = axis.dim_value
            elif _is_free(axis, index) and not axis.dim_param:  # -1 is not a length
                axis.Clear()
    if not described:
        _refuse_free(inputs, shapes, file)
    if (fixed or shapes or not all(_is_known(value) for value in model.graph.output)) and (
        model.ByteSize() < INFERRED_BYTES
    ):
        _infer(model)
    return fixed


def shapes_from(texts: Iterable[str]) -> dict[str, tuple[int | str, ...]]:
    """Return input -> axes of what a person typed as ``NAME=1,3,224,224``; a word names an axis that stays free.

    Raises:
        SourceError: for anything else.

    Example:
        >>> shapes_from(["image=1,3,224,224", "ids=1,n"])
        {'image': (1, 3, 224, 224), 'ids': (1, 'n')}
    """
    shapes: dict[str, tuple[int | str, ...]] = {}
    for text in texts:
        name, equals, listed = text.rpartition("=")
        axes = [axis.strip() for axis in listed.split(",")] if listed.strip() else []
        right = all(axis.isidentifier() or (axis.isdecimal() and int(axis)) for axis in axes)
        if not equals or not name or not right:
            raise SourceError(
                f"--shape {text!r} is not a shape of an input; wanted NAME=1,3,224,224: each axis a whole number from "
                "1, or a name for one that stays free.",
                "write it like --shape image=1,3,224,224",
            )
        shapes[name] = tuple(int(axis) if axis.isdecimal() else axis for axis in axes)
    return shapes


def axes_text(fixed: Mapping[str, Mapping[int, int]]) -> str:
    """Return which axes were fixed, in words; empty for none."""
    lengths = [f"{name} axis {index} = {length}" for name, axes in fixed.items() for index, length in axes.items()]
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


def _inputs(model: Any) -> list[Any]:
    stored = {tensor.name for tensor in model.graph.initializer}
    return [value for value in model.graph.input if value.name not in stored]


def _axes(value: Any) -> Any:
    return value.type.tensor_type.shape.dim


def _is_free(axis: Any, index: int) -> bool:
    """Return whether an axis has no length: some exporters write -1, and 0 for the batch."""
    return not axis.HasField("dim_value") or axis.dim_value < (1 if index == 0 else 0)


def _is_known(value: Any) -> bool:
    """Return whether a value has a shape, be its axes free or not."""
    return bool(value.type.tensor_type.HasField("shape"))


def _put_rank(value: Any, given: tuple[int | str, ...] | None) -> None:
    """Give a value of which the file does not say how many axes it has those that are given."""
    if given is not None and not _is_known(value):
        value.type.tensor_type.shape.SetInParent()
        for _ in given:
            value.type.tensor_type.shape.dim.add()


def _check_given(inputs: list[Any], shapes: Shapes) -> None:
    known = {value.name: value for value in inputs}
    for name, given in shapes.items():
        if name not in known:
            raise SourceError.unknown(f"--shape names '{name}', which is not an input of the file", name, known)
        own = [_length(axis, index) for index, axis in enumerate(_axes(known[name]))]
        fits = len(own) == len(given) and all(
            isinstance(axis, str) or axis == length for axis, length in zip(own, given, strict=True)
        )
        if _is_known(known[name]) and not fits:
            text = ",".join(map(str, own))
            raise SourceError(
                f"--shape gives '{name}' the shape {list(given)}; the file has {own}.",
                f"write {_option(name, text)} with numbers in the place of names",
            )


def _refuse_free(inputs: list[Any], shapes: Shapes, file: str) -> None:
    """Refuse inputs whose shape nobody knows: a length that is made up decides what is checked, counted and timed."""
    found, options = [], []
    for value in inputs:
        own = [_length(axis, index) for index, axis in enumerate(_axes(value))]
        free = [axis for index, axis in enumerate(own) if isinstance(axis, str) and index and value.name not in shapes]
        if not _is_known(value):
            found.append(f"'{value.name}' has a shape that the file does not say")
            options.append(_option(value.name, "1,AXIS,AXIS"))
        elif free:
            found.append(f"'{value.name}' has the free axes {', '.join(free)} in its shape {own}")
            options.append(_option(value.name, ",".join(map(str, own))))
    if found:
        raise SourceError(
            f"{'; '.join(found)}. The lengths that the robot gives them decide what is checked and timed.",
            f"name them: vlatool export {shlex.quote(file)} {' '.join(options)} -o BUNDLE, with numbers in place of "
            "names (a name that is left leaves its axis free)",
        )


def _length(axis: Any, index: int) -> int | str:
    """Return the length of an axis, or its name; one that has neither is named by its index."""
    return (axis.dim_param or f"n{index}") if _is_free(axis, index) else int(axis.dim_value)


def _option(name: str, axes: str) -> str:
    words = "".join(character if character.isalnum() or character in "_," else "_" for character in axes)
    return f"--shape {shlex.quote(f'{name}={words}')}"


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
        if _is_known(outputs[value.name]) and (not _is_known(value) or all(axis.dim_value > 0 for axis in axes)):
            value.CopyFrom(outputs[value.name])
    del model.graph.value_info[:]
    model.graph.value_info.extend(inferred.graph.value_info)
