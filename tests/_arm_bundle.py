"""A bundle of one addition: seven joints to a chunk of three poses, the first one where the arm is."""

from __future__ import annotations

from pathlib import Path

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec

JOINTS = tuple(f"joint{number}" for number in range(1, 8))
OFFSETS = ", ".join(str(step * 1e-4) for step in range(3) for _ in JOINTS)
GRAPH = f"""<ir_version: 10, opset_import: ["" : 20]>
g (float[1,7] q) => (float[1,3,7] pose) <float[1,3,7] w = {{{OFFSETS}}}> {{ pose = Add(q, w) }}"""


def arm_bundle(folder: Path, hz: float = 50.0) -> Bundle:
    """Write the bundle into a folder that does not exist yet."""
    import onnx
    import onnx.parser

    (folder / "graphs").mkdir(parents=True)
    onnx.save(onnx.parser.parse_model(GRAPH), folder / "graphs/main.onnx")
    action = TensorSpec("pose", (1, 3, 7), labels=JOINTS, mode="absolute")
    spec = PolicySpec((TensorSpec("q", (1, 7), labels=JOINTS),), (action,), hz, 3, 2)
    sealed = seal(folder, Manifest("arm", "1", spec, program=single_graph(spec)))
    return seal(folder, Manifest(**{**vars(sealed.manifest), "graphs": {"main": Graph("graphs/main.onnx", opset=20)}}))
