"""Quantization-aware training: the grids are those of the methods that follow; what rounding costs is learnt away."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from _arithmetic import weights_of_this_host
from _full import small_or_full
from safetensors.torch import load_file, save_file
from torch import nn

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.data import recorded_observations
from vlatool.errors import BundleError, RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.hardware.profile import load_profile
from vlatool.module.to_onnx import quiet_exporter
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.quantize.qat import Qat
from vlatool.quantize.streamed._block_quantization import (
    METHODS,
    BlockFormat,
    Scratch,
    dequantize,
    planes_from_rows,
    quantize_planes,
)
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.chain import stages_after
from vlatool.stage.run import run_transform
from vlatool.training.fake_quantization import fake_quantization, in_blocks, per_channel, per_tensor
from vlatool.user_code import trust


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))


def test_products_are_rounded_and_gradients_pass_through():
    torch.manual_seed(0)
    net = nn.Sequential(nn.Conv2d(3, 8, 3), nn.Flatten(), nn.Linear(8 * 4, 5))
    values = torch.randn(2, 3, 4, 4)
    with torch.no_grad():
        hidden = nn.functional.conv2d(per_tensor(values), per_channel(net[0].weight), net[0].bias).flatten(1)
        wanted = nn.functional.linear(per_tensor(hidden), per_channel(net[2].weight), net[2].bias)
        fours = nn.functional.linear(net[1](net[0](values)), in_blocks(net[2].weight), net[2].bias)
    with fake_quantization("int8"):
        rounded = net(values)
    with fake_quantization("int4"):
        assert torch.equal(net(values), fours)
    assert torch.equal(rounded, wanted)
    assert not torch.equal(net(values), wanted), "outside, nothing is rounded"
    rounded.sum().backward()
    assert all(value.grad is not None and bool(value.grad.abs().sum() > 0) for value in net.parameters())


def test_a_traced_module_is_rounded_alike():
    net = nn.Sequential(nn.Linear(8, 16), nn.GELU(), nn.Linear(16, 4)).eval()
    values = torch.randn(3, 8)
    with quiet_exporter():
        traced = torch.export.unflatten(torch.export.export(net, (values,)))
    with fake_quantization("int8"):
        assert torch.allclose(traced(values), net(values))


def test_int8_weights_lie_on_the_grid_of_static_int8():
    weight = torch.randn(6, 40) * torch.logspace(-3, 1, 6)[:, None]
    weight[2] = 0
    codes = per_channel(weight) / (weight.abs().amax(1, keepdim=True).clamp_min(1e-12) / 127)
    assert torch.allclose(codes, codes.round(), atol=1e-3)
    assert float(codes.abs().max()) <= 127.001


def test_int4_blocks_lie_on_the_grid_of_weight_only():
    weight = torch.randn(6, 64) * torch.logspace(-2, 1, 6)[:, None]
    weight[1, :32] = weight[1, :32].abs()
    planes = planes_from_rows(weight.reshape(-1, 32).T.numpy().copy(), Scratch())
    stored = quantize_planes(planes, BlockFormat(), METHODS["rtn"], Scratch())
    meant = dequantize(stored.codes, stored.scale, stored.zero, BlockFormat()).reshape(6, 64)
    assert np.allclose(in_blocks(weight).numpy(), meant, rtol=1e-5, atol=1e-6)
    assert in_blocks(torch.randn(3, 40)).shape == (3, 40)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_stay_as_they_are(value):
    values = torch.tensor([0.1, value, 3.3], requires_grad=True)
    given = per_tensor(values)
    assert torch.equal(torch.nan_to_num(given), torch.nan_to_num(values))
    torch.nan_to_num(given, 0.0, 0.0, 0.0).sum().backward()
    assert values.grad.tolist() == [1, 0, 1]


def test_uint8_values_hold_zero():
    values = per_tensor(torch.tensor([0.0, 0.5, 3.0, 10.0]))
    assert float(values[0]) == 0
    assert values.unique().numel() == 4
    assert torch.equal(per_tensor(torch.zeros(4)), torch.zeros(4))
    assert float(per_tensor(torch.tensor([-1.0, 2.0]))[0]) == pytest.approx(-1, abs=3 / 255)


def error(policy: object, wanted: object, bundle: Bundle) -> float:
    observations = recorded_observations(bundle, 16)
    return float(np.mean([relative_error(policy.infer(each).chunk, wanted.infer(each).chunk) for each in observations]))


@pytest.mark.parametrize("weights", small_or_full(["int8"], ["int8", "int4"]))
def test_what_rounding_costs_is_learnt_away(policy_dir: Path, tmp_path: Path, weights: str):
    stored = load_file(policy_dir / "weights.safetensors")
    for name, factor in (("mlp.1.weight", 60.0), ("mlp.1.bias", 60.0)):  # one neuron takes the whole range
        stored[f"blocks.0.{name}"][0] *= factor
    stored["blocks.0.mlp.3.weight"][:, 0] /= 60.0
    save_file(stored, policy_dir / "weights.safetensors")
    source_bundle = run_transform(TorchModule(policy=policy_dir), None, tmp_path / "source", Context()).bundle
    whole = torch_policy(source_bundle, 0)
    options = {"weights": weights, "steps": 40, "batch": 32, "average": 0.9, "episodes": 0, "student_episodes": 0,
               "learning_rate": 0.01, "loss": "l2", "threads": 1}  # fmt: skip
    tuned = run_transform(build_stage("quantize.qat", options), source_bundle, tmp_path / "tuned", Context()).bundle
    errors = []
    for name, start in (("plain", source_bundle), ("trained", tuned)):
        for number, (stage, given) in enumerate(Qat(weights=weights).chain().after.items()):
            start = run_transform(build_stage(stage, given), start, tmp_path / f"{name}{number}", Context()).bundle
        errors.append(error(load(start.path), whole, source_bundle))
    assert errors[1] < 0.8 * errors[0]
    assert [entry["stage"] for entry in start.manifest.build][-3:-1] == ["quantize.qat", "export.onnx"]
    assert rebuild(start, Context(), source=str(policy_dir), cache=tmp_path / "cache").identical


NORMALISED = """\
import torch
from torch import nn


def make():
    torch.manual_seed(0)
    body = nn.Sequential(
        nn.Conv1d(4, 8, 3, padding=1, bias=False), nn.BatchNorm1d(8, momentum=None), nn.ReLU(),
        nn.Conv1d(8, 8, 3, padding=1, groups=4), nn.BatchNorm1d(8, affine=False), nn.ReLU(), nn.BatchNorm1d(8),
        nn.Conv1d(8, 8, 1), nn.BatchNorm1d(8, track_running_stats=False), nn.Flatten(),
        nn.Linear(48, 8), nn.BatchNorm1d(8), nn.ReLU(), nn.Linear(8, 2), nn.Unflatten(1, (1, 2)),
    )
    for layer in body:
        if getattr(layer, "running_var", None) is not None:
            layer.running_mean.normal_()
            layer.running_var.uniform_(0.2, 4)
    body[1].running_mean[0], body[1].running_var[0] = 0, 1e-14  # of a channel that is nearly always the same
    body[0].weight.data[0] *= 1e-7
    return body.train()
"""
NORMALISED_YAML = """\
schema: 1
name: normalised
version: 1.0.0
source: policy.py:make
spec:
  inputs: [{name: seen, shape: [1, 4, 6], dtype: float32, unit: m}]
  outputs: [{name: action, shape: [1, 1, 2], dtype: float32, unit: m, labels: [dx, dy], mode: delta}]
  control_hz: 10
  chunk: 1
calibration: calibration.npz
"""


def test_statistics_of_normalisations_stay_and_the_export_is_what_was_trained(tmp_path: Path):
    """Whatever mode make() leaves the module in: what is trained are weights, with the statistics that are exported."""
    policy = tmp_path / "policy"
    policy.mkdir()
    (policy / "policy.py").write_text(NORMALISED)
    (policy / "policy.yaml").write_text(NORMALISED_YAML)
    np.savez(policy / "calibration.npz", seen=np.random.default_rng(0).normal(size=(40, 4, 6)).astype(np.float32))
    trust.allow(policy)
    source = run_transform(TorchModule(policy=policy), None, tmp_path / "source", Context()).bundle
    options = {"steps": 8, "batch": 6, "average": 0.5, "episodes": 0, "student_episodes": 0, "learning_rate": 0.01}
    tuned = run_transform(
        build_stage("quantize.qat", {**options, "threads": 1}), source, tmp_path / "tuned", Context()
    ).bundle
    before, after = (load_modules(bundle)["main"].state_dict() for bundle in (source, tuned))
    for name, value in before.items():
        assert torch.equal(value, after[name]) is not name.endswith(("weight", "bias")), name
    exported = run_transform(ExportOnnx(), tuned, tmp_path / "float32", Context()).bundle
    trained = torch_policy(tuned, 0)
    assert error(load(exported.path), trained, source) < 1e-5
    assert error(trained, torch_policy(source, 0), source) > 1e-3


def test_the_policy_need_not_be_changed_before(source_bundle: Bundle):
    Qat().check(source_bundle, None)


def test_an_export_of_the_tuned_policy_is_in_float32(source_bundle: Bundle, tmp_path: Path):
    options = {"steps": 2, "batch": 4, "episodes": 0, "student_episodes": 0, "threads": 1}
    tuned = run_transform(build_stage("quantize.qat", options), source_bundle, tmp_path / "tuned", Context()).bundle
    exported = run_transform(ExportOnnx(), tuned, tmp_path / "exported", Context()).bundle
    assert exported.manifest.graphs["main"].precision == {"float32": 1.0}


@pytest.mark.parametrize(("given", "board", "wanted"), [
    ({}, "", None),
    ({"layout": "qdq"}, "", {"layout": "qdq"}),
    ({}, "jetson-orin-nano", {"layout": "qdq", "activations": "int8"}),
    ({"layout": "ort"}, "jetson-orin-nano", {"activations": "int8"}),
    ({"weights": "int4"}, "jetson-orin-nano", {"search": False, "layout": "qdq"}),
    ({"weights": "int4", "layout": "ort"}, "jetson-orin-nano", {"search": False}),
])  # fmt: skip
def test_what_follows_is_as_the_board_runs_it_unless_it_is_said(
    given: dict[str, str], board: str, wanted: dict[str, object] | None
):
    export, quantization = stages_after(Qat(**given), load_profile(board) if board else None)
    assert export.name() == "export.onnx"
    assert quantization.options() == (weights_of_this_host() if wanted is None else wanted)


def test_the_bundle_tells_how_it_was_trained_and_is_not_quantized_again(
    policy_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    quick = "--steps 4 --batch 4 --episodes 0 --student-episodes 0 --threads 1"
    for line in (f"quantize qat {policy_dir} -o {out} {quick}", f"quantize qat {policy_dir} -o {out} {quick} --force"):
        with pytest.raises(SystemExit) as left:
            main(line.split())
        assert not left.value.code
        told = capsys.readouterr().out
        assert "in 4 steps on" in told
        assert "not exported yet" not in told
        assert f"loss curve: {out / 'reports/report.html'}" in told
        assert "quantize.qat" in (out / "reports" / "report.md").read_text()
    bundle = Bundle.open(out)
    with pytest.raises(BundleError, match="is int8 already") as caught:
        build_stage("quantize.static_int8", {}).check(bundle, None)
    assert caught.value.fix.startswith("quantize qat has quantized it: this bundle is its result")


def test_a_command_line_with_a_board_makes_what_the_board_runs(policy_dir: Path, tmp_path: Path):
    quick = "--steps 2 --batch 4 --episodes 0 --student-episodes 0 --threads 1"
    line = f"quantize qat {policy_dir} -o {tmp_path / 'out'} --profile jetson-orin-nano {quick}"
    with pytest.raises(SystemExit) as left:
        main(line.split())
    assert not left.value.code
    made_by = Bundle.open(tmp_path / "out").manifest.made_by
    assert made_by["stage"] == "quantize.static_int8"
    assert made_by["options"] == {"layout": "qdq", "activations": "int8"}


def test_a_layout_that_cannot_follow_is_told_before_the_training(source_bundle: Bundle):
    with pytest.raises(RecipeError, match=r"quantize.weight_only: layout = 'openvino': input should be 'ort' or 'qdq'"):
        Qat(weights="int4", layout="openvino").check(source_bundle, None)
    Qat(weights="int8", layout="openvino").check(source_bundle, None)
