"""A policy whose steps attend to a prefix: keys and values are exported as a graph that runs once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from torch import nn

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.export.onnx import ExportOnnx
from vlatool.graph.macs import COMPUTE
from vlatool.module.divergence import first_divergence
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

YAML = """\
name: attends
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 32]}]
  outputs: [{name: action, shape: [1, 4, 2]}]
  control_hz: 10
  chunk: 4
program:
  - {graph: prefix, feeds: {state: state}, gives: {context: context}}
  - graph: step
    feeds: {x: x, t: t, context: context}
    gives: {x_next: action}
    repeat: 4
    carry: {action: x}
    schedule: {t: [1.0, 0.75, 0.5, 0.25]}
    noise: {x: {shape: [1, 4, 2]}}
"""
POLICY = """\
import torch
from torch import nn


class Prefix(nn.Module):
    def __init__(self):
        super().__init__()
        self.see = nn.Linear(32, 6 * 32)

    def forward(self, state):
        return torch.tanh(self.see(state)).unflatten(1, (6, 32))


class Step(nn.Module):
    def __init__(self):
        super().__init__()
        self.embed, self.query, self.out = nn.Linear(2, 32), nn.Linear(32, 32), nn.Linear(32, 2)
        self.key_value = nn.Linear(32, 64)

    def forward(self, x, t, context):
        tokens = torch.tanh(self.embed(x.to(torch.TYPE) * t[:, None, None].to(torch.TYPE)))
        key, value = self.key_value(context.to(torch.TYPE)).chunk(2, -1)
        seen = torch.softmax(self.query(tokens) @ key.transpose(1, 2), -1) @ value
        return x - 0.25 * self.out(tokens + seen).float()


def make():
    torch.manual_seed(0)
    return {"prefix": Prefix().eval(), "step": Step().to(torch.TYPE).eval()}
"""


def exported(folder: Path, kind: str = "float32", prefix: str = "prefix", **options: bool) -> tuple[Bundle, Bundle]:
    """Return the source bundle and the exported one."""
    folder.mkdir(exist_ok=True)
    (folder / "policy.yaml").write_text(YAML.replace("graph: prefix", f"graph: {prefix}"))
    (folder / "policy.py").write_text(POLICY.replace("torch.TYPE", f"torch.{kind}").replace('"prefix"', f'"{prefix}"'))
    states = np.random.default_rng(0).standard_normal((32, 32)).astype(np.float32)
    np.savez(folder / "calibration.npz", state=states)
    for made in ("source", "exported"):
        (folder / made).mkdir()
    source = TorchModule(policy=folder).run(None, folder / "source", Context()).bundle
    return source, ExportOnnx(**options).run(source, folder / "exported", Context()).bundle


def products(bundle: Bundle, graph: str) -> list[str]:
    model = onnx.load(bundle.file(bundle.manifest.graphs[graph].file))
    onnx.checker.check_model(model)
    return [node.name for node in model.graph.node if node.op_type in COMPUTE]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Bundle, Bundle]:
    return exported(tmp_path_factory.mktemp("attends") / "policy")


def test_keys_and_values_are_computed_once(made):
    source, bundle = made
    assert [(step.graph, step.repeat) for step in bundle.manifest.program] == [
        ("prefix", 1), ("step_once", 1), ("step", 4)
    ]  # fmt: skip
    assert products(bundle, "step_once") == ["key_value/MatMul"]
    assert "key_value/MatMul" not in products(bundle, "step")
    assert bundle.manifest.program[2].noise == source.manifest.program[1].noise


def test_the_actions_are_those_of_torch_and_of_the_whole_graph(made, tmp_path: Path):
    source, bundle = made
    _, whole = exported(tmp_path / "policy", loop_invariants=False)
    assert set(whole.manifest.graphs) == {"prefix", "step"}
    torch, once, anew = torch_policy(source, 3), load(bundle.path, seed=3), load(whole.path, seed=3)
    for observation in recorded_observations(source, 6):
        wanted, got, same = (policy.infer(observation).chunk for policy in (torch, once, anew))
        assert relative_error(got, wanted) < 1e-5
        assert relative_error(got, same) < 1e-6


@pytest.mark.parametrize(("kind", "allowed"), [("bfloat16", 0.03), ("float16", 0.01), ("float64", 1e-5)])
def test_other_types_are_computed_once_too(tmp_path: Path, kind, allowed):
    source, bundle = exported(tmp_path / "policy", kind)
    assert "step_once" in bundle.manifest.graphs
    torch, once = torch_policy(source, 3), load(bundle.path, seed=3)
    for observation in recorded_observations(source, 3):
        assert relative_error(once.infer(observation).chunk, torch.infer(observation).chunk) < allowed


@pytest.mark.parametrize("stage", [DynamicInt8(), StaticInt8(samples=16), WeightOnly()])
def test_what_follows_takes_the_graph_as_any_other(made, tmp_path: Path, stage):
    (tmp_path / "out").mkdir()
    changed = stage.run(made[1], tmp_path / "out", Context()).bundle
    assert set(changed.manifest.graphs) == {"prefix", "step_once", "step"}
    before, after = load(made[1].path, seed=0), load(changed.path, seed=0)
    observation = recorded_observations(made[0], 1)[0]
    assert relative_error(after.infer(observation).chunk, before.infer(observation).chunk) < 0.3


@pytest.mark.parametrize("graph", ["step_once", "step"])
def test_a_difference_in_either_part_is_found(made, tmp_path: Path, graph):
    source, bundle = made
    (modules, feeds), files = torch_feeds(source), dict[str, Path]()
    for name in ("step_once", "step"):
        model = onnx.load(bundle.file(bundle.manifest.graphs[name].file))
        if name == graph:
            largest = max(model.graph.initializer, key=lambda each: len(each.raw_data))
            values = onnx.numpy_helper.to_array(largest)
            largest.CopyFrom(onnx.numpy_helper.from_array(values * np.float32(1.5), largest.name))
        files[name] = tmp_path / f"{name}.onnx"
        onnx.save(model, files[name])
    node = first_divergence(modules["step"], files["step"], feeds, 1e-3, [files["step_once"]])
    assert node.startswith(("key_value/", "out/") if graph == "step_once" else "query/")


def torch_feeds(source: Bundle) -> tuple[dict[str, nn.Module], dict[str, np.ndarray]]:
    """Return the modules, and what the step is given first."""
    random = np.random.default_rng(0)
    shapes = {"x": (1, 4, 2), "t": (1,), "context": (1, 6, 32)}
    return load_modules(source), {name: random.normal(size=shape).astype("f4") for name, shape in shapes.items()}


def test_two_exports_give_equal_bytes(made, tmp_path: Path):
    again = exported(tmp_path / "policy")[1]
    assert again.manifest.files["graphs/step_once.onnx"] == made[1].manifest.files["graphs/step_once.onnx"]
    assert again.manifest.files["graphs/step.onnx"] == made[1].manifest.files["graphs/step.onnx"]


def test_the_new_graph_takes_no_name_that_is_taken(tmp_path: Path):
    _, bundle = exported(tmp_path / "policy", prefix="step_once")
    assert set(bundle.manifest.graphs) == {"step_once", "step_once_", "step"}
