"""A bundle that an ARM core computes otherwise than an x86 one, by no trick: both do what C leaves open.

A negative number that becomes an unsigned one wraps around on x86 (-3.0 is 65,533 as uint16) and becomes 0 on ARM. The
graph adds such a conversion to the action. Nothing is forged: graph, golden action and hashes are written by the steps
that write every bundle, and the bundle is right on the host that made it.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from _variants import VariantError
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.stage.finish import GOLDEN_COUNT, carry_over, finish

STEPS = 16.0
"""What the action is multiplied by before it becomes whole numbers."""
WRAPPED = 2.0**-16
"""What those are multiplied by: one that wrapped around counts as 1."""


def plant(source: Path, out: Path) -> Path:
    """Write a bundle that ARM computes otherwise.

    Args:
        source: A float32 bundle.
        out: Where the new one goes; what is there is removed.

    Raises:
        VariantError: when no graph of its last step gives the action.
    """
    shutil.rmtree(out, ignore_errors=True)
    bundle = Bundle.open(source)
    last = bundle.manifest.program[-1]
    file = bundle.manifest.graphs[last.graph].file
    outputs = [output for output, value in last.gives.items() if value == bundle.manifest.spec.action.name]
    if not outputs:
        raise VariantError(f"The last step of {source} does not give the action, so nothing can be planted there.")
    carry_over(bundle, out, ("assets", "data", "graphs"))
    model = onnx.load(source / file)
    convert(model.graph, outputs[0])
    onnx.save(model, out / file)
    observations = observations_for(bundle, GOLDEN_COUNT)
    made_by = {"stage": "tests.planted", "options": {}}
    return finish(bundle, out, made_by=made_by, graphs=bundle.manifest.graphs, observations=observations).path


def convert(graph: Any, output: str) -> None:
    """Add to an output what becomes of it as whole unsigned numbers."""
    for node in graph.node:
        for index, name in enumerate(node.output):
            if name == output:
                node.output[index] = "plain"
    for name, value in (("steps", STEPS), ("wrapped", WRAPPED)):
        graph.initializer.append(numpy_helper.from_array(np.float32(value), name))
    graph.node.extend([
        helper.make_node("Mul", ["plain", "steps"], ["scaled"]),
        helper.make_node("Cast", ["scaled"], ["whole"], to=TensorProto.UINT16),
        helper.make_node("Cast", ["whole"], ["counted"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["counted", "wrapped"], ["added"]),
        helper.make_node("Add", ["plain", "added"], [output]),
    ])  # fmt: skip
