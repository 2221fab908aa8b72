"""Training after pruning that set single weights to zero: they stay zero, whatever trains and however often."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.numpy import load_file

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.torch_policy import load_modules
from vlatool.module.zeros import has_zeros, sparse_weights, zero_share
from vlatool.prune.magnitude import Magnitude
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

SHORT = {"steps": 6, "batch": 6, "episodes": 0, "student_episodes": 0, "learning_rate": 0.01, "average": 0.5,
         "precision": "float32"}  # fmt: skip


@pytest.fixture(autouse=True)
def in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))


@pytest.fixture
def sparse(source_bundle: Bundle, tmp_path: Path) -> Bundle:
    return run_transform(Magnitude(pattern="2:4"), source_bundle, tmp_path / "sparse", Context()).bundle


def layers(bundle: Bundle) -> dict[str, torch.Tensor]:
    stored = load_file(bundle.path / "module/main.safetensors")
    return {name: torch.from_numpy(value) for name, value in stored.items() if value.ndim > 1 and "blocks" in name}


@pytest.mark.parametrize("options", [{}, {"accumulate": 2}, {"processes": 2, "threads": 2}])
def test_zeros_of_two_of_four_stay(sparse: Bundle, tmp_path: Path, options: dict[str, int]):
    stage = build_stage("distill.policy", {**SHORT, **options})
    made = run_transform(stage, sparse, tmp_path / "made", Context()).bundle
    again = run_transform(stage, made, tmp_path / "again", Context()).bundle
    for before, after, last in zip(layers(sparse).values(), layers(made).values(), layers(again).values(), strict=True):
        assert not torch.equal(before, after), "the others learn"
        assert torch.equal(before == 0, after == 0)
        assert torch.equal(before == 0, last == 0)
    share = zero_share(made)
    assert share > 0.3
    assert f"weights that pruning set to zero are still zero: {share:.1%} of all" in stage.summarize(made)


def test_quantization_aware_training_keeps_them(sparse: Bundle):
    stage = build_stage("quantize.qat", {"steps": 2, "batch": 6, "episodes": 0, "student_episodes": 0})
    modules = load_modules(sparse)
    _, objective = stage.prepare_objective(modules, sparse)
    assert objective.constraint is not None
    weight = modules["main"].blocks[0].mlp[1].weight
    zero = weight == 0
    with objective.constraint.step(1):
        weight.data += 1
    assert torch.equal(weight == 0, zero)


def test_zeros_of_a_policy_that_was_never_pruned_are_free(source_bundle: Bundle):
    modules = load_modules(source_bundle)
    modules["main"].blocks[0].mlp[1].weight.data[:, :4] = 0
    assert not has_zeros(source_bundle)
    stage = build_stage("quantize.qat", {"steps": 2, "batch": 6, "episodes": 0, "student_episodes": 0})
    assert stage.prepare_objective(modules, source_bundle)[1].constraint is None
    assert len(sparse_weights(modules.values())) == 1
    modules["main"].blocks[0].mlp[1].weight.data[:] = 0
    assert not sparse_weights([*modules.values(), *modules.values()]), "made so by its author"


def test_a_stage_of_a_package_that_is_not_here_left_no_zeros(source_bundle: Bundle):
    build = (*source_bundle.manifest.build, {"stage": "prune.of_another_package"}, {})
    assert not has_zeros(replace(source_bundle, manifest=replace(source_bundle.manifest, build=build)))


def test_parts_of_layers_cannot_keep_them(sparse: Bundle):
    with pytest.raises(RecipeError, match="--shard cuts layers into parts, and tiny has weights that pruning set to"):
        build_stage("distill.policy", {**SHORT, "processes": 2, "shard": True}).check(sparse, None)
