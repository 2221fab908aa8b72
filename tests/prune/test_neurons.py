"""Structured pruning: which neurons go, and that what is left is the policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.boards.torch_workload import torch_workload
from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.distill.weights import Weights
from vlatool.errors import BundleError, RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.edits import read_edits
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune.neurons import Neurons, hidden_layers
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform


def actions(policy, bundle: Bundle) -> np.ndarray:
    return np.stack([policy.infer(each).outputs["action"] for each in recorded_observations(bundle, 8)])


@pytest.fixture
def pruned(source_bundle: Bundle, tmp_path: Path) -> Bundle:
    """The tiny policy with half of its hidden neurons."""
    return run_transform(Neurons(ratio=0.5), source_bundle, tmp_path / "pruned", Context()).bundle


def test_neurons_of_least_magnitude_go(pruned: Bundle, source_bundle: Bundle):
    before, after = load_modules(source_bundle)["main"], load_modules(pruned)["main"]
    ((first, second, incoming, outgoing),) = hidden_layers(before)
    magnitude = incoming.weight.norm(dim=1) * outgoing.weight.norm(dim=0)
    (edit, other) = read_edits(pruned)
    assert (edit.module, edit.axis, other.module, other.axis) == (first, "outputs", second, "inputs")
    assert edit.keep == other.keep == tuple(sorted(torch.argsort(magnitude, descending=True)[:16].tolist()))
    assert after.get_submodule(first).out_features == 16
    torch.testing.assert_close(after.get_submodule(second).weight, outgoing.weight[:, list(edit.keep)])


def test_it_is_exported_run_and_made_again(pruned: Bundle, policy_template: Path, tmp_path: Path):
    made = run_transform(ExportOnnx(), pruned, tmp_path / "exported", Context()).bundle
    got = actions(load(made.path, threads=1), made)
    assert relative_error(got, actions(torch_policy(pruned, 0), made)) < 1e-5
    assert [entry["stage"] for entry in made.manifest.build] == [
        "sources.torch_module",
        "prune.neurons",
        "export.onnx",
    ]
    again = rebuild(made, Context(), source=str(policy_template), cache=tmp_path / "cache")
    assert again.identical


def test_it_is_smaller_and_counted_as_such(pruned: Bundle, source_bundle: Bundle):
    macs = [sum(torch_workload(each).graphs["main"].macs.values()) for each in (source_bundle, pruned)]
    assert macs[1] < macs[0]


def test_pruning_again_starts_where_it_was(pruned: Bundle, tmp_path: Path):
    again = run_transform(Neurons(ratio=0.5), pruned, tmp_path / "again", Context()).bundle
    assert [len(edit.keep) for edit in read_edits(again)] == [16, 16, 8, 8]
    assert again.manifest.parent == pruned.hash
    torch_policy(again, 0).infer(recorded_observations(again, 1)[0])


def test_other_weights_take_the_structure_that_is_left(pruned: Bundle, tmp_path: Path):
    stage = build_stage("distill.weights", {"file": str(pruned.path / "module/main.safetensors")})
    assert isinstance(stage, Weights)
    tuned = run_transform(stage, pruned, tmp_path / "tuned", Context()).bundle
    assert relative_error(actions(torch_policy(tuned, 0), tuned), actions(torch_policy(pruned, 0), pruned)) == 0


def test_the_share_is_rounded_to_what_vector_units_want():
    layer, after = nn.Linear(4, 30), nn.Linear(30, 2)
    assert [len(Neurons(ratio=ratio)._kept_neurons(layer, after)) for ratio in (0.01, 0.25, 0.5, 0.99)] == [
        30,
        24,
        16,
        8,
    ]
    assert len(Neurons(ratio=0.5, multiple=1)._kept_neurons(layer, after)) == 15


def test_layers_are_hidden_where_nothing_else_reads_them():
    class Other(nn.Sequential):
        def forward(self, x):
            return self[2](self[0](x)) + self[0](x).mean()

    shared = nn.Linear(4, 4)
    chains = {
        "plain": (nn.Sequential(nn.Linear(2, 4), nn.GELU(), nn.Dropout(), nn.Linear(4, 4), nn.Linear(4, 1)), 2),
        "a norm between": (nn.Sequential(nn.Linear(2, 4), nn.LayerNorm(4), nn.Linear(4, 1)), 0),
        "a forward of its own": (Other(nn.Linear(2, 4), nn.ReLU(), nn.Linear(4, 4)), 0),
        "tied weights": (nn.Sequential(nn.Linear(4, 4), nn.ReLU(), shared, nn.ReLU(), shared), 0),
    }
    assert {name: len(list(hidden_layers(net))) for name, (net, _) in chains.items()} == {
        name: count for name, (_, count) in chains.items()
    }


def test_patterns_choose_and_wrong_ones_are_named(source_bundle: Bundle, tmp_path: Path):
    for options, says in (
        ({"include": ("mlq*",)}, "No hidden layer matches 'mlq"),
        ({"exclude": ("*",)}, "no hidden layer"),
    ):
        with pytest.raises(RecipeError, match=says):
            run_transform(Neurons(**options), source_bundle, tmp_path / "out", Context())
    assert not (tmp_path / "out").exists()


def test_what_has_graphs_cannot_be_pruned(float_bundle: Bundle, tmp_path: Path):
    with pytest.raises(BundleError, match=r"has no torch modules that prune\.neurons could change"):
        run_transform(Neurons(), float_bundle, tmp_path / "out", Context())
