"""ONNX files: read with names for all nodes, written with their weights, split in two."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlatool.bundle.manifest import Graph
from vlatool.bundle.program import ProgramStep
from vlatool.errors import GraphError, VlatoolError, require
from vlatool.graph.nodes import detach_constant_outputs, name_nodes
from vlatool.graph.phase import cut_phases


def split_phases(
    program: tuple[ProgramStep, ...], name: str, path: Path
) -> tuple[tuple[ProgramStep, ...], dict[str, Graph]]:
    """Move the phases of a graph into a file beside it; return the new program and the new graph.

    Nothing changes without a phase that depends on an input, or when the graph runs in a loop, which a program cannot
    split between two graphs.
    """
    steps = [step for step in program if step.graph == name]
    if any(step.repeat > 1 for step in steps):
        return program, {}
    model = load(path)
    cut = cut_phases(model)
    if cut is None:
        return program, {}
    other = f"{name}_phases"
    file = f"graphs/{other}.onnx"
    save(model, path)
    save(cut.model, path.parent / f"{other}.onnx")
    values = {value: f"{other}.{value}" for value in cut.values}
    steps_after: list[ProgramStep] = []
    for step in program:
        if step.graph != name:
            steps_after.append(step)
            continue
        before = {key: getattr(step, key) for key in ("schedule", "noise", "keep", "slow")}
        feeds = {key: step.feeds[key] for key in cut.kept}
        steps_after.append(ProgramStep(other, {key: step.feeds[key] for key in cut.inputs}, values, **before))
        steps_after.append(replace(step, feeds={**feeds, **values}, schedule={}, noise={}, keep={}))
    return tuple(steps_after), {other: Graph(file, {}, 0)}


def load(path: Path) -> Any:
    """Load an ONNX model with its weights, without the recorded shapes, on which ONNX Runtime's quantizer fails.

    The dynamo exporter records the shape of a Gemm's weight before a transposition that the quantizer undoes; without
    ``value_info`` the shapes are inferred anew.
    """
    model = read(path)
    del model.graph.value_info[:]
    return model


def read(path: Path, *, weights: bool = True) -> Any:
    """Read an ONNX model; node names are unique, no output is constant; raises GraphError without its weight files."""
    onnx = require("onnx", "build")
    try:
        model = onnx.load(str(path), load_external_data=weights)
    except (OSError, onnx.checker.ValidationError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise GraphError(
            f"The weights of {path} cannot be read: {reason}.", "put the file of its weights next to the graph"
        ) from error
    name_nodes(model)
    detach_constant_outputs(model)
    return model


def save(model: Any, path: Path) -> None:
    """Write an ONNX model; weights beyond protobuf's 2 GiB go to a file beside it. Never appends to stale data."""
    onnx = require("onnx", "build")
    large = model.ByteSize() > 1_500_000_000
    data = path.with_name(path.name + ".data")
    data.unlink(missing_ok=True)
    onnx.save(model, str(path), save_as_external_data=large, location=data.name)


def write_linked(model: Any, original: Path, target: Path) -> Path:
    """Write a model that was read without its weights to another directory, with links to the files of its weights."""
    target.write_bytes(model.SerializeToString())
    for data in original.parent.glob("*.data"):
        if not (target.parent / data.name).exists():
            link(data, target.parent / data.name)
    return target


def link(original: Path, copy: Path) -> None:
    """Create a hard link; copy the file where the file system does not support it.

    ONNX Runtime does not follow symbolic links out of the model's directory.
    """
    try:
        os.link(original, copy)
    except OSError:
        shutil.copyfile(original, copy)


@contextlib.contextmanager
def foreign_errors(graph: str) -> Iterator[None]:
    """Convert exceptions of onnx and ONNX Runtime to errors of the graph that is quantized."""
    try:
        yield
    except (VlatoolError, OSError, MemoryError):
        raise
    except Exception as error:  # the seam: onnx and ONNX Runtime raise many foreign types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise GraphError(
            f"The graph '{graph}' cannot be quantized: {type(error).__name__}: {reason}.",
            "exclude layers with --exclude, or use another method; export the policy again if it is damaged",
        ) from error
