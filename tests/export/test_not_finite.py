"""A policy whose spec says ``finite: false`` for an input takes NaN and infinity in all of vlatool, there alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _full import small_or_full

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import Drawer, calibration_recording, observations_for, synthetic_observations, with_not_finite
from vlatool.errors import DataError, GraphError, RecipeError, SpecError
from vlatool.evaluate.recorded import Recorded
from vlatool.export.onnx import ExportOnnx
from vlatool.files.npz import open_npz
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context, Transform
from vlatool.stage.finish import read_difference

YAML = """\
name: open
source: policy.py:make
spec:
  inputs:
    - {name: depth, shape: [1, 6, 6], finite: false}
    - {name: state, shape: [1, 3]}
  outputs: [{name: y, shape: [1, 2]}]
  control_hz: 10
"""
PY = """\
import torch
from torch import nn
from torch.nn import functional as F

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.first, self.body, self.head = nn.Linear(6, 8), nn.Linear(8, 8), nn.Linear(8, 2)
        self.state = nn.Linear(3, 8)

    def forward(self, depth, state=None):
        BODY

    def finish(self, rows, state):
        return self.head(torch.relu(self.body(torch.relu(self.first(rows)))).mean(1) + self.state(state))

def make():
    return Policy()
"""
POLICIES = {
    "nan_to_num": "return self.finish(torch.nan_to_num(depth, 0.0, 5.0, -5.0), state)",
    "where": "return self.finish(torch.where(torch.isfinite(depth), depth, 0.0), state)",
    "clamp": "return self.finish(torch.where(torch.isnan(depth), 0.0, depth).clamp(-5, 5), state)",
    "mask and product": """seen = torch.isfinite(depth)
        total = torch.where(seen, depth, 0.0).sum(2, keepdim=True) / seen.sum(2, keepdim=True).clamp_min(1)
        return self.finish(torch.nan_to_num(depth, 0.0, 0.0, 0.0) * seen + total * (~seen), state)""",
    "pooled validity": """seen = F.max_pool2d(torch.isfinite(depth).float()[:, None], 3, 1, 1)[:, 0]
        return self.finish(torch.nan_to_num(depth, 0.0, 0.0, 0.0) + seen, state)""",
    "pooled depth": """near = F.max_pool2d(torch.where(torch.isnan(depth), -torch.inf, depth)[:, None], 3, 1, 1)[:, 0]
        return self.finish(torch.clamp(near, -5, 5), state)""",
    "inverse": """inverse = 1 / (1 + torch.where(torch.isnan(depth), torch.inf, depth).abs())
        return self.finish(inverse, state)""",
    "behind a layer": """rows = self.first(depth)
        rows = torch.relu(torch.nan_to_num(rows, 0.0, 1.0, -1.0))
        return self.head(torch.relu(self.body(rows)).mean(1) + self.state(state))""",
}


def source(folder: Path, body: str, description: str = YAML, **recorded: Any) -> Bundle:
    """Write a policy, record what is given, and return its source bundle."""
    folder.mkdir()
    (folder / "policy.py").write_text(PY.replace("BODY", body))
    (folder / "policy.yaml").write_text(description)
    if recorded:
        np.savez(folder / "calibration.npz", **recorded)
    out = folder / "source"
    out.mkdir()
    return TorchModule(policy=folder).run(None, out, Context()).bundle


def made(stage: Transform, bundle: Bundle, out: Path) -> Bundle:
    out.mkdir()
    return stage.run(bundle, out, Context()).bundle


def recording(samples: int = 24) -> dict[str, Any]:
    """Return observations and actions; every other depth image has pixels without a return."""
    random = np.random.default_rng(1)
    depth = random.normal(2, 1, (samples, 6, 6)).astype(np.float32)
    depth[::2, :2, 3] = np.nan
    depth[::4, 4, :2] = np.inf
    state = random.normal(size=(samples, 3)).astype(np.float32)
    return {"depth": depth, "state": state, "action": random.normal(size=(samples, 1, 2)).astype(np.float32)}


def answers(bundle: Bundle) -> np.ndarray:
    policy = load(bundle.path)
    return np.stack([policy.infer(each).chunk for each in synthetic_observations(bundle, 12)])


@pytest.mark.parametrize(
    "name", small_or_full(["nan_to_num", "mask and product", "pooled depth", "behind a layer"], POLICIES)
)
def test_a_policy_that_handles_them_is_exported_and_quantized(tmp_path: Path, name: str):
    bundle = source(tmp_path / "policy", POLICIES[name], **recording())
    exported = made(ExportOnnx(), bundle, tmp_path / "float")
    expected = answers(exported)
    for number, stage in enumerate((StaticInt8(), StaticInt8(layout="qdq"), DynamicInt8())):
        quantized = made(stage, exported, tmp_path / f"int8-{number}")
        assert quantized.manifest.findings == (), stage
        assert "int8" in quantized.manifest.graphs["main"].precision
        assert np.linalg.norm(answers(quantized) - expected) < 0.1 * np.linalg.norm(expected)
        difference = read_difference(quantized)
        assert difference is not None
        assert difference.worst < 0.2
    if name == "behind a layer":  # infinity times a weight that is rounded to zero is another value
        return
    weights = made(WeightOnly(method="gptq", bits=8), exported, tmp_path / "weights")
    assert np.linalg.norm(answers(weights) - expected) < 0.05 * np.linalg.norm(expected)


def test_golden_and_compared_observations_hold_such_values(tmp_path: Path):
    bundle = source(tmp_path / "policy", POLICIES["where"])
    exported = made(ExportOnnx(), bundle, tmp_path / "float")
    golden = open_npz(exported.path / exported.manifest.golden)["in.depth"]
    held = np.stack([each["depth"] for each in observations_for(exported, 32)])
    for values in (golden, held):
        assert np.isnan(values).any()
        assert np.isposinf(values).any()
        assert np.isneginf(values).any()
    whole = np.isfinite(held).all(axis=(1, 2))
    assert whole.sum() == 8
    assert np.isfinite(held[~whole]).any(axis=(1, 2)).all()
    assert np.isfinite(open_npz(exported.path / exported.manifest.golden)["in.state"]).all()


def test_which_values_are_not_finite_is_the_same_when_asked_again():
    spec = PolicySpec((TensorSpec("x", (1, 5), finite=False),), (TensorSpec("y", (1, 1)),), 10)
    once = with_not_finite(spec, [{"x": np.arange(5.0)} for _ in range(16)])
    again = with_not_finite(spec, once)
    assert all(np.array_equal(one["x"], other["x"], equal_nan=True) for one, other in zip(once, again, strict=True))
    kinds = np.concatenate([each["x"] for each in once])
    assert np.isnan(kinds).any()
    assert np.isposinf(kinds).any()
    assert np.isneginf(kinds).any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_inference_takes_them_in_that_input_alone(tmp_path: Path, value: float):
    bundle = made(ExportOnnx(), source(tmp_path / "policy", POLICIES["where"]), tmp_path / "float")
    policy = load(bundle.path)
    depth, state = np.ones((6, 6), np.float32), np.ones(3, np.float32)
    depth[2, 2] = value
    assert np.isfinite(policy.infer({"depth": depth, "state": state}).chunk).all()
    assert np.isfinite(policy.infer({"depth": np.full((6, 6), value), "state": state}).chunk).all()
    with pytest.raises(DataError, match="The input 'state' holds") as caught:
        policy.infer({"depth": depth, "state": np.array([1, value, 1], np.float32)})
    assert "finite: false" in caught.value.fix


def test_a_normalised_state_with_infinity(tmp_path: Path):
    description = YAML.replace(
        "{name: state, shape: [1, 3]}",
        "{name: state, shape: [1, 3], finite: false, normalisation: mean_std, statistics: s.json#state}",
    )
    (tmp_path / "s.json").write_text(json.dumps({"state": {"mean": [0, 1, 2], "std": [1, 1, 2]}}))
    folder = tmp_path / "policy"
    body = "return self.finish(torch.nan_to_num(depth), torch.nan_to_num(state, 0.0, 3.0, -3.0))"
    folder.mkdir()
    (folder / "s.json").write_text((tmp_path / "s.json").read_text())
    (folder / "policy.py").write_text(
        PY.replace("BODY", body.replace("torch.nan_to_num(depth)", "torch.nan_to_num(depth, 0.0, 3.0, -3.0)"))
    )
    (folder / "policy.yaml").write_text(description)
    (folder / "source").mkdir()
    bundle = TorchModule(policy=folder).run(None, folder / "source", Context()).bundle
    exported = made(ExportOnnx(), bundle, tmp_path / "float")
    action = load(exported.path).infer({"depth": np.zeros((6, 6)), "state": [np.inf, np.nan, -np.inf]})
    assert np.isfinite(action.chunk).all()


@pytest.mark.parametrize(
    "body", ["return self.finish(depth, state)", "return self.finish(torch.nan_to_num(depth, 0.0, torch.inf), state)"]
)
def test_a_policy_that_answers_nan_to_them_is_told_with_which_values(tmp_path: Path, body: str):
    bundle = source(tmp_path / "policy", body)
    with pytest.raises(
        GraphError, match=r"which holds \d+ NaN and \d+ inf and \d+ -inf in the 36 values of 'depth'"
    ) as caught:
        made(ExportOnnx(), bundle, tmp_path / "float")
    assert caught.value.fix.startswith("its spec says finite: false: ")


def test_a_recording_may_hold_them_in_that_input_alone(tmp_path: Path):
    bundle = source(tmp_path / "policy", POLICIES["where"], **recording())
    assert calibration_recording(bundle) is not None
    arrays = recording()
    arrays["state"][5, 1] = np.nan
    with pytest.raises(
        DataError,
        match=rf"'state' in {tmp_path}/other/calibration.npz is not finite in 1 of 24 samples; the first is sample 5",
    ):
        source(tmp_path / "other", POLICIES["where"], **arrays)


def test_drawn_observations_of_a_gate_hold_them_in_that_input_alone(tmp_path: Path):
    bundle = source(tmp_path / "policy", POLICIES["where"])
    drawn = [each.observation for each in Drawer(bundle).draw(32, np.random.default_rng(0))]
    whole = [bool(np.isfinite(each["depth"]).all()) for each in drawn]
    assert 0 < sum(whole) < 32
    assert all(np.isfinite(each["state"]).all() for each in drawn)


def test_a_recording_with_them_evaluates(tmp_path: Path):
    bundle = source(tmp_path / "policy", POLICIES["where"], **recording())
    exported = made(ExportOnnx(), bundle, tmp_path / "float")
    report = Recorded().run(exported, Context())
    assert all(np.isfinite(each.value) for each in report.rows[-1].measurements if each.name.startswith("error"))


def test_a_graph_whose_layers_all_read_them_is_not_quantized(tmp_path: Path):
    body = "return torch.nan_to_num(self.head(self.first(depth)), 0.0, 1.0, -1.0).mean(1)"
    bundle = source(tmp_path / "policy", body, YAML.replace("    - {name: state, shape: [1, 3]}\n", ""))
    exported = made(ExportOnnx(), bundle, tmp_path / "float")
    with pytest.raises(RecipeError, match="reads NaN or infinity"):
        made(DynamicInt8(), exported, tmp_path / "int8")


@pytest.mark.parametrize(
    ("tensor", "message"),
    [
        ({"name": "x", "shape": [1, 3], "dtype": "uint8", "finite": False}, "'x' says finite: false, but is uint8"),
        ({"name": "x", "shape": [1, 3], "finite": "no"}, "'x' has finite 'no'; it must be true or false"),
        ({"name": "x", "kind": "text", "tokenizer": "v", "max_tokens": 2, "finite": False}, "but is text"),
    ],
)
def test_a_field_that_cannot_be(tensor, message):
    with pytest.raises(SpecError, match=message):
        TensorSpec.from_dict(tensor)


def test_an_output_is_always_finite():
    with pytest.raises(SpecError, match="The output 'y' says finite: false"):
        PolicySpec((TensorSpec("x", (1, 3)),), (TensorSpec("y", (1, 1), finite=False),), 10)


def test_a_manifest_without_the_field_means_finite():
    assert TensorSpec.from_dict({"name": "x", "shape": [1, 3]}).finite
    assert "finite" not in TensorSpec("x", (1, 3)).to_dict()
    assert TensorSpec("x", (1, 3), finite=False).to_dict()["finite"] is False
