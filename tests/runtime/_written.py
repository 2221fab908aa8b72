"""Bundles of graphs that are written as text."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import ProgramStep, single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.stage.finish import save_npz

X = TensorSpec("x", (1, 2))
Y = TensorSpec("y", (1, 2))
MEMORY = (ProgramStep("main", {"x": "x", "h": "h"}, {"y": "y", "n": "h"}, keep={"h": {"shape": [1, 2]}}),)
"""The program of a graph that takes its memory as ``h`` and gives the next as ``n``."""
SUM = "g (float[1,2] x, float[1,2] h) => (float[1,2] y, float[1,2] n) { n = Add(h, x)  y = Add(n, n) }"
ENDLESS = """g (float[1,2] x) => (float[1,2] y)
    <int64 trips = {4611686018427387904}, bool go = {1}> {
        y = Loop (trips, go, x) <body = b (int64 i, bool c, float[1,2] a) => (bool d, float[1,2] e) {
            d = Identity(c)
            e = Neg(a)
        }>
    }"""
"""2^62 turns."""


def written(
    folder: Path,
    text: str,
    inputs: tuple[TensorSpec, ...] = (X,),
    outputs: tuple[TensorSpec, ...] = (Y,),
    program: tuple[ProgramStep, ...] = (),
    golden: dict[str, Any] | None = None,
    hz: float = 10.0,
    **spec: Any,
) -> Bundle:
    """Seal a bundle of one graph; golden: ``in.x`` and ``out.y``, each with a sample axis."""
    (folder / "graphs").mkdir(parents=True)
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}')
    onnx.save(model, str(folder / "graphs/main.onnx"))
    described = PolicySpec(inputs, outputs, hz, **spec)
    manifest = Manifest("written", "1", described, program=program or single_graph(described))
    changes: dict[str, Any] = {}
    if golden is not None:
        (folder / "golden").mkdir()
        save_npz(folder / "golden/golden.npz", {name: np.asarray(value, np.float32) for name, value in golden.items()})
        changes["golden"] = "golden/golden.npz"
    sealed = seal(folder, manifest)
    whole = Manifest(
        **{**vars(sealed.manifest), "graphs": {"main": Graph("graphs/main.onnx", opset=20)}, **changes}
    )  # fmt: skip
    return seal(folder, whole)
