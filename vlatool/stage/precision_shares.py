"""The precision of a graph's layers, counted in a run where the file does not say their shapes."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import VlatoolError, require
from vlatool.files.scratch import scratch_directory
from vlatool.graph.control_flow import with_unique_names
from vlatool.graph.files import write_linked
from vlatool.graph.onnx_graph import type_name
from vlatool.graph.precision import shares_and_unknown
from vlatool.graph.run_shapes import RunShapes, read_run_shapes, write_run_shapes
from vlatool.machine.engine_calls import engine_call
from vlatool.runtime.engine import engine_class
from vlatool.runtime.engines import open_traced

MAX_NAMES = 4
"""Layers that a sentence names."""


def count_shares(path: Path) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return precision -> share of a graph's multiply-accumulates, and a sentence on layers that are not counted.

    Where layers have no static shape, or a loop ends nobody knows when, the graph is run once on drawn inputs, and what
    that shows is noted in its file, for all who count it later.

    Args:
        path: written by a stage that runs where its engine may crash; no other name of the file is in use.
    """
    shares, unknown = shares_and_unknown(path)
    seen = _run(path) if unknown else {}
    if not seen.keys().isdisjoint(unknown):
        model = require("onnx", "build").load(str(path), load_external_data=False)
        wanted = {*unknown, *read_run_shapes(model)}  # shapes of an earlier graph hold for layers that are the same
        write_run_shapes(model, {name: node for name, node in seen.items() if name in wanted})
        path.write_bytes(model.SerializeToString())
        shares, unknown = shares_and_unknown(path)
    if not unknown:
        return shares, ()
    more = f" and {len(unknown) - MAX_NAMES} more" if len(unknown) > MAX_NAMES else ""
    named = ", ".join(unknown[:MAX_NAMES]) + more
    return shares, (f"{path.stem}: not counted, for want of fixed shapes: {named}",)


def _run(path: Path) -> dict[str, RunShapes]:
    """Return node -> what one run shows; nothing where the graph does not run on drawn inputs."""
    onnx = require("onnx", "build")
    model = with_unique_names(onnx.load(str(path), load_external_data=False))
    stored = {tensor.name for tensor in model.graph.initializer}
    with scratch_directory() as scratch, contextlib.suppress(VlatoolError):
        copy = write_linked(model, path, scratch / path.name)
        with engine_call(engine_class(), f"ran {path.name} to see its shapes"):
            session = open_traced(copy, scratch / "trace")
            try:
                session.run(_draw_inputs([value for value in model.graph.input if value.name not in stored]))
            except Exception:  # the seam: what ONNX Runtime refuses, and types that numpy lacks, is not counted
                return {}
            return {name: RunShapes(*ran) for name, ran in session.ran().items()}
    return {}


def _draw_inputs(values: list[Any]) -> dict[str, Any]:
    """Return arrays that fit the inputs of a graph, each free axis of length 1: zeros for ids, ones without axes."""
    random = np.random.default_rng(0)
    feeds = {}
    for value in values:
        kind = value.type.tensor_type
        shape = tuple(axis.dim_value if axis.dim_value > 0 else 1 for axis in kind.shape.dim)
        dtype = np.dtype(type_name(kind.elem_type))
        whole = np.full(shape, not shape or dtype.kind == "b", dtype)
        feeds[value.name] = np.asarray(random.standard_normal(shape), dtype) if dtype.kind == "f" else whole
    return feeds
