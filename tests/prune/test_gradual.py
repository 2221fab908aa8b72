"""Zeros that grow while a policy is trained: when, how many, and that training makes up for them."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from _flow import write_flow
from safetensors.numpy import load_file

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.errors import RecipeError
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune._sparse_base import select_layers
from vlatool.prune.gradual import Gradual
from vlatool.prune.magnitude import Magnitude
from vlatool.prune.structured import Structured
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.loop import Trainer
from vlatool.training.stage import TrainingStage

SHORT = {"steps": 12, "batch": 6, "episodes": 0, "student_episodes": 0, "learning_rate": 0.003, "interval": 2,
         "precision": "float32"}  # fmt: skip
LAYER = "blocks.0.mlp.1.weight"


@pytest.fixture(autouse=True)
def in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))


def grown(source: Bundle, out: Path, **options: object) -> Bundle:
    return run_transform(build_stage("prune.gradual", {**SHORT, **options}), source, out, Context()).bundle


def error(bundle: Bundle, whole: Bundle) -> float:
    ours, theirs = torch_policy(bundle, 0), torch_policy(whole, 0)
    observations = recorded_observations(whole, 16)
    return float(np.mean([relative_error(ours.infer(each).chunk, theirs.infer(each).chunk) for each in observations]))


def test_the_share_grows_as_a_cube():
    shares = Gradual(steps=100, until=0.5, interval=10, ratio=0.8).shares()
    assert list(shares) == [10, 20, 30, 40, 50]
    assert shares[10] == pytest.approx(0.8 - 0.8 * (1 - 10 / 50) ** 3)
    assert shares[50] == 0.8
    assert list(Gradual(steps=3, until=0.1, interval=10).shares().values()) == [0.5], "once, in the first step"
    assert list(Gradual(steps=25, until=1.0, interval=10).shares()) == [10, 20, 25]


def test_training_makes_up_for_the_zeros(source_bundle: Bundle, policy_template: Path, tmp_path: Path):
    at_once = run_transform(Magnitude(ratio=0.7), source_bundle, tmp_path / "once", Context()).bundle
    made = grown(source_bundle, tmp_path / "made", ratio=0.7, steps=60, batch=16, average=0.9, threads=1)
    assert error(made, source_bundle) < 0.7 * error(at_once, source_bundle)
    for bundle in (at_once, made):
        zeros = [int((values == 0).sum()) for name, values in load_file(bundle.path / "module/main.safetensors").items()
                 if name == LAYER]  # fmt: skip
        assert zeros == [round(0.7 * 32 * 16)]
    first, *_ = Gradual(**SHORT).summarize(made)
    assert "of the weights are zero; no tensor is smaller" in first
    assert rebuild(made, Context(), source=str(policy_template), cache=tmp_path / "cache").identical


def test_patterns_hold_in_the_end(source_bundle: Bundle, tmp_path: Path):
    made = grown(source_bundle, tmp_path / "made", pattern="2:4")
    values = load_file(made.path / "module/main.safetensors")[LAYER]
    assert set((values == 0).reshape(-1, 4).sum(1).tolist()) == {2}


def test_a_run_that_is_killed_goes_on_and_two_processes_have_the_same_zeros(
    source_bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    class Killed(BaseException):
        pass

    whole = grown(source_bundle, tmp_path / "whole")
    two = grown(source_bundle, tmp_path / "two", processes=2)
    take, settings, dies = Trainer._take_step, TrainingStage.settings, [1, 4, 5, 9]

    def taking(self: Trainer, draw: object) -> None:
        take(self, draw)
        if dies and self.step == dies[0]:
            dies.pop(0)
            raise Killed

    monkeypatch.setattr(Trainer, "_take_step", taking)
    monkeypatch.setattr(TrainingStage, "settings", lambda self: replace(settings(self), checkpoint_s=0.0))
    for _ in range(4):
        with pytest.raises(Killed):
            grown(source_bundle, tmp_path / "killed")
    killed = grown(source_bundle, tmp_path / "killed")
    tensors = [load_file(made.path / "module/main.safetensors") for made in (whole, killed, two)]
    assert all(np.array_equal(value, tensors[1][name]) for name, value in tensors[0].items())
    assert all(np.array_equal(value == 0, tensors[2][name] == 0) for name, value in tensors[0].items())


def test_layers_of_the_same_name_in_two_graphs_are_two(tmp_path: Path):
    source = run_transform(
        TorchModule(policy=write_flow(tmp_path / "flow")), None, tmp_path / "source", Context()
    ).bundle
    modules = load_modules(source)
    modules["prefix"].body = torch.nn.Sequential(torch.nn.Linear(3, 3))
    layers = select_layers(modules, source, (), ())
    assert list(layers.prunable) == ["head.body.0", "prefix.see", "prefix.body.0"]
    assert layers.dense == ("head.body.2",), "it gives the action"
    assert list(select_layers(modules, source, ("body.0",), ()).prunable) == ["head.body.0", "prefix.body.0"]
    assert list(select_layers(modules, source, ("prefix.*",), ("see",)).prunable) == ["prefix.body.0"]
    modules["prefix"].body = modules["head"].body
    assert list(select_layers(modules, source, ("body.*",), ()).prunable) == ["head.body.0", "head.body.2"], (
        "shared ones once"
    )


@pytest.mark.parametrize(("options", "says"), [
    ({"pattern": "2:4", "ratio": 0.7}, "The pattern 2:4 keeps half of the weights"),
    ({"patience": 2}, "--patience could choose weights from before the last zeros"),
    ({"include": ("blok.*",)}, r"No layer matches 'blok.\*'"),
    ({"exclude": ("*",)}, "has no layer to prune"),
    ({"until": 0.0}, "until = 0"),
    ({"until": 1.5}, "until = 1.5"),
    ({"interval": 0}, "interval = 0"),
    ({"ratio": 1.0}, "ratio = 1"),
    ({"loss": "kl"}, "kl compares discrete actions"),
])  # fmt: skip
def test_wrong_options_are_told(source_bundle: Bundle, tmp_path: Path, options: dict[str, object], says: str):
    with pytest.raises(RecipeError, match=says):
        grown(source_bundle, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_the_class_is_the_stage():
    assert importlib.import_module("vlatool.prune.gradual").Gradual.name() == "prune.gradual"


def test_a_policy_that_lost_units_gets_zeros_and_keeps_them(
    source_bundle: Bundle, policy_template: Path, tmp_path: Path
):
    narrower = run_transform(
        Structured(ratio=0.3, multiple=1, rank="magnitude"), source_bundle, tmp_path / "narrower", Context()
    ).bundle
    made = grown(narrower, tmp_path / "made", ratio=0.7)
    tensors = [load_file(each.path / "module/main.safetensors") for each in (narrower, made)]
    assert tensors[0][LAYER].size < 32 * 16
    assert {name: value.shape for name, value in tensors[0].items()} == {
        name: value.shape for name, value in tensors[1].items()
    }
    assert (tensors[1][LAYER] == 0).sum() == round(0.7 * tensors[1][LAYER].size)
    assert rebuild(made, Context(), source=str(policy_template), cache=tmp_path / "cache").identical
