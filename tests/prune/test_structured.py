"""Structured pruning: as much work goes as was asked for, the least important units first; what is left is exported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from vlatool.boards.torch_workload import torch_workload
from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.distill.policy import PolicyDistillation
from vlatool.errors import BundleError, RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.graph.workload import workload
from vlatool.module.edits import read_edits
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune.structured import Structured
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

FINE = {"samples": 4, "multiple": 1}


def actions(policy, bundle: Bundle) -> np.ndarray:
    return np.stack([policy.infer(each).outputs["action"] for each in recorded_observations(bundle, 8)])


@pytest.fixture(scope="module")
def pruned(source_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy with a third less work; read only."""
    return run_transform(Structured(ratio=0.3, **FINE), source_bundle, tmp_path_factory.mktemp("s") / "out", Context())


def work(bundle: Bundle) -> int:
    return sum(workload(bundle).graphs["main"].macs.values())


def test_as_much_work_goes_as_was_asked_and_the_export_is_made_again(
    pruned: Bundle, source_bundle: Bundle, float_bundle: Bundle, policy_template: Path, tmp_path: Path
):
    made = run_transform(ExportOnnx(), pruned, tmp_path / "out", Context())
    assert 0.6 < work(made) / work(float_bundle) <= 0.7
    assert relative_error(actions(load(made.path, threads=1), made), actions(torch_policy(pruned, 0), made)) < 1e-5
    assert rebuild(made, Context(), source=str(policy_template), cache=tmp_path / "cache").identical


def test_it_is_counted_without_its_weights_too(pruned: Bundle, source_bundle: Bundle):
    counts = [sum(torch_workload(bundle).graphs["main"].macs.values()) for bundle in (source_bundle, pruned)]
    assert 0.6 < counts[1] / counts[0] <= 0.7


@pytest.mark.parametrize("rank", ["gate", "magnitude"])
def test_units_that_do_nothing_go_first(source_bundle: Bundle, rank: str):
    modules = load_modules(source_bundle)
    linear = modules["main"].blocks[0].mlp[3]
    with torch.no_grad():
        linear.weight[:, 5:] = 0
    stage = Structured(ratio=0.2, rank=rank, include=("blocks.0.mlp.*",), least=0.1, **FINE)
    (edit,) = stage.change(modules, source_bundle, Context()).edits
    assert set(range(5)) <= set(edit.keep)
    assert len(edit.keep) < 32


def test_a_random_choice_is_the_same_each_time(source_bundle: Bundle):
    stage = Structured(rank="random", **FINE)
    chosen = [stage.change(load_modules(source_bundle), source_bundle, Context()) for _ in range(2)]
    assert chosen[0] == chosen[1]
    assert chosen[0] != Structured(rank="magnitude", **FINE).change(
        load_modules(source_bundle), source_bundle, Context()
    )


def test_widths_stay_multiples(source_bundle: Bundle):
    stage = Structured(ratio=0.3, multiple=8, samples=2)
    for edit in stage.change(load_modules(source_bundle), source_bundle, Context()).edits:
        assert len(edit.keep) % 8 == 0


def test_pruning_again_keeps_what_both_keep(pruned: Bundle, tmp_path: Path):
    again = run_transform(Structured(ratio=0.1, **FINE), pruned, tmp_path / "again", Context())
    before, after = read_edits(pruned), read_edits(again)
    assert {(edit.module, edit.axis) for edit in after} >= {(edit.module, edit.axis) for edit in before}
    assert len({(edit.module, edit.axis) for edit in after}) == len(after)
    assert load_modules(again)["main"] is not None


def test_it_is_trained_further(pruned: Bundle, source_bundle: Bundle, tmp_path: Path):
    stage = PolicyDistillation(
        steps=40, batch=8, episodes=0, student_episodes=0, learning_rate=0.003, average=0.9, threads=1
    )
    made = run_transform(stage, pruned, tmp_path / "out", Context())
    wanted = actions(torch_policy(source_bundle, 0), source_bundle)
    before, after = (relative_error(actions(torch_policy(each, 0), source_bundle), wanted) for each in (pruned, made))
    assert after < before


@pytest.mark.parametrize(("options", "says"), [
    ({"include": ("blok*",)}, r"No weight that can be pruned matches 'blok\*'"),
    ({"exclude": ("*",)}, "has no heads, neurons or channels that could go"),
    ({"ratio": 0.95}, r"No more than \d+.\d% of the multiply-accumulates can go"),
])  # fmt: skip
def test_wrong_options_are_told(source_bundle: Bundle, tmp_path: Path, options: dict[str, object], says: str):
    stage = build_stage("prune.structured", {"rank": "magnitude", **options})
    with pytest.raises(RecipeError, match=says):
        stage.change(load_modules(source_bundle), source_bundle, Context())


def test_what_has_graphs_cannot_be_pruned(float_bundle: Bundle, tmp_path: Path):
    with pytest.raises(BundleError, match="has no torch modules"):
        run_transform(Structured(), float_bundle, tmp_path / "out", Context())
