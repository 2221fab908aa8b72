"""A small bundle with one of everything that is attacked, and what it answers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime import load
from vlatool.runtime.policy import Policy, relative_error
from vlatool.stage.finish import GOLDEN, save_npz, write_golden

VOCABULARY = {"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2, "to": 3, "the": 4, "red": 5, "ball": 6}}
STATISTICS = {
    "state": {"mean": [0.5, -0.25, 1.5], "std": [1.25, 0.5, 2.0]},
    "action": {"min": [-1.0, -2.0], "max": [1.5, 3.0]},
}
SPEC = PolicySpec(
    (
        TensorSpec("state", (1, 3), normalisation="mean_std", statistics="statistics.json#state"),
        TensorSpec("say", (1, 4), "int64", "text", tokenizer="vocabulary.json", max_tokens=4),
    ),
    (TensorSpec("action", (1, 2, 2), normalisation="min_max", statistics="statistics.json#action", unit="m"),),
    10.0,
    chunk=2,
)
PROGRAM = (
    ProgramStep("encode", {"state": "state", "say": "say"}, {"seen": "seen"}),
    ProgramStep(
        "act",
        {"seen": "seen", "memory": "memory", "noise": "noise", "time": "time"},
        {"out": "action", "next": "memory", "less": "less"},
        repeat=2,
        carry={"less": "noise"},
        schedule={"time": [0.0, 0.5]},
        noise={"noise": {"shape": [1, 4]}},
        keep={"memory": {"shape": [1, 4]}},
    ),
)
OBSERVATIONS: tuple[dict[str, Any], ...] = (
    {"state": np.array([0.1, 0.2, 0.3], np.float32), "say": "go to the ball"},
    {"state": np.array([1.0, -1.0, 2.0], np.float32), "say": "red ball"},
    {"state": np.array([-0.7, 0.4, 0.9], np.float32), "say": "the red"},
    {"state": np.array([2.5, 0.1, -1.9], np.float32), "say": ""},
)
"""The first two are the golden ones."""


def make(folder: Path) -> Bundle:
    """Write the bundle: two graphs, one with its weights beside it, noise, a schedule, kept and carried values."""
    for name in ("graphs", "assets", "data"):
        (folder / name).mkdir(parents=True)
    (folder / "assets/vocabulary.json").write_text(json.dumps(VOCABULARY))
    (folder / "assets/statistics.json").write_text(json.dumps(STATISTICS))
    save_npz(folder / "data/evaluation.npz", {"state": np.stack([each["state"] for each in OBSERVATIONS])})
    _encode(folder / "graphs")
    _act(folder / "graphs")
    sealed = seal(folder, Manifest("victim", "1.0.0", SPEC, program=PROGRAM))
    graphs = {name: Graph(f"graphs/{name}.onnx", {"float32": 1.0}, 20) for name in ("encode", "act")}
    draft = seal(folder, replace(sealed.manifest, graphs=graphs))
    write_golden(draft, [dict(each) for each in OBSERVATIONS[:2]], folder)
    return seal(folder, replace(draft.manifest, golden=GOLDEN))


def answers(path: Path) -> list[Any]:
    """Load a bundle and return what it does with every observation, the golden ones first: chunk and labels."""
    policy = load(path, threads=1, seed=0)
    return of(policy)


def of(policy: Policy) -> list[Any]:
    """Return what an open policy does with every observation."""
    policy.reset()
    found = [policy.infer(each) for each in OBSERVATIONS]
    return [(action.chunk, action.labels, policy.spec.control_hz) for action in found]


def equal(one: list[Any], other: list[Any]) -> bool:
    """Say whether two lists of answers are the same numbers and words."""
    return all(
        left[1:] == right[1:] and left[0].shape == right[0].shape and np.allclose(left[0], right[0], 1e-5, 1e-6)
        for left, right in zip(one, other, strict=True)
    )


def far(wanted: list[Any], got: list[Any], tolerance: float = 0.25) -> bool:
    """Say whether an answer to a golden observation is further from the original's than the golden check allows."""
    return any(
        not relative_error(right[0], left[0]) <= tolerance for left, right in zip(wanted[:2], got[:2], strict=True)
    )


def _encode(folder: Path) -> None:
    random = np.random.default_rng(1)
    state, words = (random.standard_normal(shape).astype(np.float32) for shape in ((3, 4), (8, 4)))
    nodes = [
        helper.make_node("MatMul", ["state", "w"], ["a"]),
        helper.make_node("Gather", ["words", "say"], ["b"]),
        helper.make_node("ReduceMean", ["b", "axis"], ["c"], keepdims=0),
        helper.make_node("Add", ["a", "c"], ["d"]),
        helper.make_node("Tanh", ["d"], ["seen"]),
    ]
    values = {"w": state, "words": words, "axis": np.array([1], np.int64)}
    inputs = [("state", TensorProto.FLOAT, (1, 3)), ("say", TensorProto.INT64, (1, 4))]
    model = _model(nodes, inputs, [("seen", TensorProto.FLOAT, (1, 4))], values)
    (folder / "encode.onnx").write_bytes(model.SerializeToString())


def _act(folder: Path) -> None:
    random = np.random.default_rng(2)
    weight = random.standard_normal((4, 4)).astype(np.float32)
    nodes = [
        helper.make_node("Add", ["seen", "memory"], ["a"]),
        helper.make_node("MatMul", ["a", "v"], ["b"]),
        helper.make_node("Mul", ["noise", "time"], ["c"]),
        helper.make_node("Add", ["b", "c"], ["d"]),
        helper.make_node("Tanh", ["d"], ["next"]),
        helper.make_node("Mul", ["noise", "half"], ["less"]),
        helper.make_node("Reshape", ["d", "shape"], ["out"]),
    ]
    values = {"v": weight, "half": np.array([0.5], np.float32), "shape": np.array([1, 2, 2], np.int64)}
    inputs = [(name, TensorProto.FLOAT, (1, 4)) for name in ("seen", "memory", "noise")]
    outputs = [("out", TensorProto.FLOAT, (1, 2, 2)), ("next", TensorProto.FLOAT, (1, 4)), ("less", 1, (1, 4))]
    model = _model(nodes, [*inputs, ("time", TensorProto.FLOAT, (1,))], outputs, values)
    (folder / "act.data").write_bytes(weight.tobytes())
    tensor = next(each for each in model.graph.initializer if each.name == "v")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", "act.data"), ("offset", "0"), ("length", str(weight.nbytes))):
        tensor.external_data.add(key=key, value=value)
    (folder / "act.onnx").write_bytes(model.SerializeToString())


def _model(nodes: list[Any], inputs: list[Any], outputs: list[Any], values: dict[str, Any]) -> Any:
    described = [[helper.make_tensor_value_info(*each) for each in side] for side in (inputs, outputs)]
    graph = helper.make_graph(nodes, "g", *described, [numpy_helper.from_array(v, k) for k, v in values.items()])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
