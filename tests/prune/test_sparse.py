"""Zeros in weights: how many, where, what they cost, and that nobody is told that they are faster."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.errors import RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import load_modules
from vlatool.prune._output_layers import output_layers
from vlatool.prune._product_observer import observe_products
from vlatool.prune._sparse_base import LayerSelection, SparsePruning, select_layers
from vlatool.prune.magnitude import Magnitude
from vlatool.prune.sparsegpt import SparseGpt
from vlatool.prune.structured import Structured
from vlatool.prune.wanda import Wanda
from vlatool.runtime import load
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

METHODS = (Magnitude, Wanda, SparseGpt)


def layer_data(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A weight, and inputs whose elements go together and differ in size."""
    random = torch.Generator().manual_seed(seed)
    mixed = torch.randn(400, 24, generator=random, dtype=torch.float64) @ torch.randn(
        24, 24, generator=random, dtype=torch.float64
    )
    return torch.randn(16, 24, generator=random), mixed * torch.logspace(-1, 1, 24)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ratio", [0.25, 0.5, 0.7])
def test_as_many_weights_as_asked_are_zero(method: type[SparsePruning], ratio: float):
    weight, rows = layer_data()
    made = method(ratio=ratio).prune_weight(weight.clone(), rows.T @ rows / len(rows))
    assert float((made == 0).float().mean()) == pytest.approx(ratio, abs=0.02)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("pattern", "of"), [("2:4", 4), ("4:8", 8)])
def test_patterns_hold_among_neighbours(method: type[SparsePruning], pattern: str, of: int):
    weight, rows = layer_data()
    made = method(pattern=pattern).prune_weight(weight.clone(), rows.T @ rows / len(rows))
    zeros = (made == 0).reshape(len(made), -1, of).sum(-1)
    assert set(zeros.unique().tolist()) == {of // 2}


def test_what_looks_at_the_inputs_loses_less_and_correcting_loses_least():
    weight, rows = layer_data()
    wanted = rows @ weight.double().T
    errors = [
        float(
            torch.linalg.norm(
                rows @ method().prune_weight(weight.clone(), rows.T @ rows / len(rows)).double().T - wanted
            )
        )
        for method in METHODS
    ]
    assert errors[2] < 0.8 * errors[1]
    assert errors[1] < errors[0]


@pytest.mark.parametrize("layer", [
    nn.Linear(6, 4), nn.Conv2d(6, 4, 3, stride=2, padding=1), nn.Conv2d(6, 4, 3, padding="same"),
    nn.Conv1d(6, 4, 3, padding=1, dilation=1),
])  # fmt: skip
def test_rows_are_what_the_weight_is_multiplied_with(layer: nn.Module):
    shape = {nn.Linear: (2, 5, 6), nn.Conv1d: (2, 6, 9), nn.Conv2d: (2, 6, 9, 9)}[type(layer)]
    given, seen = torch.randn(shape), list[torch.Tensor]()
    with observe_products(lambda weight, rows: seen.append(rows @ weight.detach().reshape(4, -1).T)):
        layer(given)
    (product,) = seen
    wanted = layer(given) - layer.bias.reshape((4, *[1] * (len(shape) - 2)) if len(shape) > 2 and not isinstance(
        layer, nn.Linear) else (4,))  # fmt: skip
    wanted = wanted if isinstance(layer, nn.Linear) else wanted.movedim(1, -1)
    torch.testing.assert_close(product.reshape(wanted.shape), wanted.detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_a_policy_is_exported_with_its_zeros_and_nobody_is_told_that_it_is_faster(
    method: type[SparsePruning], source_bundle: Bundle, tmp_path: Path
):
    stage = method(samples=4, include=("blocks.*",))
    pruned = run_transform(stage, source_bundle, tmp_path / "pruned", Context()).bundle
    linear = load_modules(pruned)["main"].blocks[0].mlp[1]
    assert float((linear.weight == 0).float().mean()) == pytest.approx(0.5, abs=0.02)
    first, second, *_ = stage.summarize(pruned)
    assert "of the weights are zero; no tensor is smaller" in first
    assert "nothing is faster" in second
    if method is Wanda:
        made = run_transform(ExportOnnx(), pruned, tmp_path / "out", Context()).bundle
        assert load(made.path).infer(recorded_observations(made, 1)[0]).chunk.shape == (4, 2)


def test_what_gives_the_action_stays_dense_whatever_it_is_called(source_bundle: Bundle):
    modules = load_modules(source_bundle)
    policy = modules["main"]
    policy.last, policy.head = policy.head, nn.Sequential(nn.Linear(16, 16), nn.ReLU())
    policy.head[0].weight.data.copy_(torch.eye(16))
    policy.forward = lambda *inputs: policy.last(type(policy).forward(policy, *inputs).flatten(1)[:, :8].repeat(1, 2))
    policy.head.append(nn.Linear(16, 8))
    found = select_layers(modules, source_bundle, (), ())
    assert {"vision", "state", "blocks.0.query"} <= set(found.prunable)
    assert set(found.dense) == {"last", "head.0", "head.2"}
    assert list(select_layers(modules, source_bundle, ("last",), ()).prunable) == ["last"]
    changes = Magnitude().change(modules, source_bundle, Context())
    assert changes.messages == ("left dense: head.0, head.2, last (--include names what else may go)",)
    assert int((policy.last.weight == 0).sum()) == 0


def test_frozen_weights_are_found_and_stay_frozen(source_bundle: Bundle):
    modules = load_modules(source_bundle)
    policy = modules["main"].requires_grad_(False)
    layers = [policy.head, policy.state, policy.vision]
    assert output_layers(modules, source_bundle, layers) == {id(policy.head)}
    assert not any(weight.requires_grad for weight in policy.parameters())


def test_many_dense_layers_are_counted():
    assert LayerSelection({}, ()).describe() == ()
    (told,) = LayerSelection({}, tuple(map(str, range(10)))).describe()
    assert told.startswith("left dense: 0, 1, 2, 3, 4, 5, 6, 7 and 2 more (")


def test_a_part_that_the_description_names_so_stays_dense(source_bundle: Bundle):
    described = replace(source_bundle, manifest=replace(source_bundle.manifest, parts={"action_expert": ["blocks.*"]}))
    found = select_layers(load_modules(described), described, (), ())
    assert set(found.prunable) == {"vision", "state"}


@pytest.mark.parametrize(("options", "says"), [
    ({"include": ("blok.*",)}, r"No layer matches 'blok.\*'"),
    ({"exclude": ("*",)}, "has no layer to prune"),
    ({"pattern": "2:4", "ratio": 0.7}, "The pattern 2:4 keeps half of the weights"),
])  # fmt: skip
def test_wrong_options_are_told(source_bundle: Bundle, options: dict[str, object], says: str):
    with pytest.raises(RecipeError, match=says):
        Magnitude(**options).change(load_modules(source_bundle), source_bundle, Context())


@pytest.fixture(scope="module")
def narrower(source_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy without a third of its work, and so traced; read only."""
    stage = Structured(ratio=0.3, multiple=1, rank="magnitude")
    return run_transform(stage, source_bundle, tmp_path_factory.mktemp("narrower") / "out", Context()).bundle


@pytest.mark.parametrize("method", METHODS)
def test_layers_that_lost_units_are_the_same_layers(
    method: type[SparsePruning], narrower: Bundle, source_bundle: Bundle
):
    modules, whole = load_modules(narrower), select_layers(load_modules(source_bundle), source_bundle, (), ())
    found = select_layers(modules, narrower, (), ())
    assert (set(found.prunable), set(found.dense)) == (set(whole.prunable), set(whole.dense))
    before = {name: layer.weight.detach().clone() for name, layer in found.prunable.items()}
    method(samples=4).change(modules, narrower, Context())
    shares = [float((layer.weight == 0).float().mean()) for layer in found.prunable.values()]
    assert shares == pytest.approx([0.5] * len(shares), abs=0.2)  # of three inputs, two
    changed = [not torch.equal(layer.weight[layer.weight != 0], before[name][layer.weight != 0])
               for name, layer in found.prunable.items()]  # fmt: skip
    assert any(changed) == (method is SparseGpt), "it alone corrects what stays, by what layers are given"


def test_what_layers_are_given_is_seen_in_traced_ones_too(narrower: Bundle):
    modules = load_modules(narrower)
    layers = select_layers(modules, narrower, (), ()).prunable
    given = Wanda(samples=4)._input_moments(layers, modules, narrower, Context())
    assert {name: tuple(total.shape) for name, total in given.items()} == {
        name: (layer.weight[0].numel(),) * 2 for name, layer in layers.items()
    }
