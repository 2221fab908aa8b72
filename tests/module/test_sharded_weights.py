"""Modules whose weights stay in shards: the same tensors as in memory, one at a time, whatever blocks are gone."""

from __future__ import annotations

import json
import shutil
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from _llama import write_llama
from safetensors.torch import load_file, save_file

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import SourceError
from vlatool.export.onnx import ExportOnnx
from vlatool.module import sharded_weights, stage
from vlatool.module.edits import apply, holds_weights, read_edits
from vlatool.module.sharded_weights import graph_weights, stored_modules, takes_shards, weights_on_demand
from vlatool.module.torch_policy import load_modules, policy_of, torch_policy, unedited_modules
from vlatool.prune.depth import Depth
from vlatool.prune.neurons import Neurons
from vlatool.quantize.weight_only import LOSS_REPORT, WeightOnly
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.samples._language import DecoderShape
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

SHAPE = DecoderShape(width=64, layers=5, heads=4, shared_heads=2, head_width=16, hidden=96)
LARGEST = 96 * 64 * 4
KEPT = (0, 2, 4)
STACK = ("decoder.layers",)


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shards") / "policy"
    write_llama(folder, shape=SHAPE, vocabulary=64, length=6, shard_bytes=60_000)
    assert len(list(folder.glob("*.safetensors"))) > 2
    return folder


def sourced(folder: Path, out: Path) -> Bundle:
    out.mkdir(parents=True)
    return TorchModule(policy=folder).run(None, out, Context()).bundle


@pytest.fixture(scope="module")
def whole(shards, tmp_path_factory) -> Bundle:
    return sourced(shards, tmp_path_factory.mktemp("whole") / "bundle")


@pytest.fixture(scope="module")
def pruned(whole, tmp_path_factory) -> Bundle:
    return run_transform(
        Depth(keep=KEPT, include=STACK), whole, tmp_path_factory.mktemp("pruned") / "out", Context()
    ).bundle


def action(bundle: Bundle, policy) -> np.ndarray:
    policy.reset()
    return policy.infer(observations_for(bundle, 1)[0]).chunk


class Held:
    """Counts the bytes of the weights that exist: the most, and how many were read."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = self.most = self.reads = 0
        original = sharded_weights.read_tensor

        def read(*arguments):
            tensor = original(*arguments)
            self.now += tensor.nbytes
            self.reads += 1
            self.most = max(self.most, self.now)
            weakref.finalize(tensor, self.free, tensor.nbytes)
            return tensor

        monkeypatch.setattr(sharded_weights, "read_tensor", read)

    def free(self, size: int) -> None:
        self.now -= size


def test_the_bundle_holds_the_edits_alone(pruned: Bundle):
    assert [name for name in pruned.manifest.files if name.startswith("module/")] == ["module/edits.json"]
    assert [edit.keep for edit in read_edits(pruned)] == [KEPT]
    assert takes_shards(pruned)
    assert "stay in the shards" in stage.describe_modules(pruned)[0]


def test_the_modules_are_those_that_are_made_in_memory(whole: Bundle, pruned: Bundle):
    wanted = apply(unedited_modules(whole), read_edits(pruned))["main"].state_dict()
    got = load_modules(pruned)["main"].state_dict()
    assert list(got) == list(wanted)
    assert all(torch.equal(got[name], value) and got[name].dtype == value.dtype for name, value in wanted.items())


def test_running_from_shards_is_running_in_memory(pruned: Bundle, monkeypatch):
    held, modules = Held(monkeypatch), stored_modules(pruned)
    with weights_on_demand(modules):
        got = action(pruned, policy_of(pruned, modules.modules, 0))
    assert held.most == LARGEST
    assert modules.nbytes > 5 * LARGEST
    np.testing.assert_array_equal(got, action(pruned, torch_policy(pruned, 0)))
    assert all(value.is_meta for value in modules.modules["main"].parameters())


def test_what_is_exported_is_what_is_exported_from_memory(whole: Bundle, pruned: Bundle, tmp_path, monkeypatch):
    (tmp_path / "memory").mkdir()
    modules = apply(unedited_modules(whole), read_edits(pruned))
    memory = stage.write_modules(whole, tmp_path / "memory", read_edits(pruned), modules, {"stage": "prune.depth"})
    assert holds_weights(memory)
    assert not takes_shards(memory)
    one = run_transform(ExportOnnx(samples=1), memory, tmp_path / "one", Context()).bundle
    held = Held(monkeypatch)
    (tmp_path / "other").mkdir()
    other = ExportOnnx(samples=1).run(pruned, tmp_path / "other", Context()).bundle
    assert held.now == 0
    np.testing.assert_array_equal(action(other, load(other.path)), action(one, load(one.path)))


def test_weight_only_quantizes_the_blocks_that_are_kept(whole: Bundle, pruned: Bundle, tmp_path):
    def layers(bundle: Bundle, name: str) -> dict:
        made = run_transform(WeightOnly(), bundle, tmp_path / name, Context()).bundle
        assert action(made, load(made.path)).shape == (8, 7)
        return {each["layer"]: each for each in json.loads((made.path / LOSS_REPORT).read_text())["layers"]}

    one, other = layers(whole, "whole"), layers(pruned, "pruned")
    assert len(other) == 7 * 3 + 1
    for number, before in enumerate(KEPT):
        moved, was = f"decoder.layers.{number}.query/MatMul", f"decoder.layers.{before}.query/MatMul"
        assert other[moved]["sha256"] == one[was]["sha256"]
    assert one["decoder.layers.1.query/MatMul"]["sha256"] != one["decoder.layers.2.query/MatMul"]["sha256"]


def test_a_choice_without_a_run_reads_nothing(whole: Bundle, tmp_path, monkeypatch):
    held = Held(monkeypatch)
    monkeypatch.setattr(stage, "MAX_RUN_BYTES", 0)
    (tmp_path / "even").mkdir()
    made = Depth(rank="even", include=STACK).run(whole, tmp_path / "even", Context()).bundle
    assert [edit.keep for edit in read_edits(made)] == [(0, 2, 4)]
    assert held.reads == 0


def test_cosine_from_shards_chooses_as_in_memory(whole: Bundle, tmp_path, monkeypatch):
    held = Held(monkeypatch)
    (tmp_path / "cosine").mkdir()
    ranked = Depth(rank="cosine", include=STACK, samples=2)
    made = ranked.run(whole, tmp_path / "cosine", Context()).bundle
    assert 0 < held.most == LARGEST
    assert read_edits(made) == ranked.change(load_modules(whole), whole, Context()).edits


@pytest.mark.parametrize("rank", ["error", "gate"])
def test_weights_stay_in_shards_after_a_ranking_in_memory(whole: Bundle, tmp_path, rank):
    made = run_transform(Depth(rank=rank, include=STACK, samples=2), whole, tmp_path / "out", Context()).bundle
    assert takes_shards(made)
    assert len(read_edits(made)[0].keep) == 3


def test_blocks_go_twice(pruned: Bundle, whole: Bundle, tmp_path):
    again = run_transform(Depth(keep=(1, 2), include=STACK), pruned, tmp_path / "out", Context()).bundle
    wanted = dict(unedited_modules(whole)["main"].decoder.layers[4].named_parameters())
    got = dict(load_modules(again)["main"].decoder.layers[1].named_parameters())
    assert all(torch.equal(got[name], value) for name, value in wanted.items())


def test_it_is_rebuilt_to_the_same_bytes(pruned: Bundle, shards: Path, tmp_path):
    assert rebuild(pruned, Context(), source=str(shards), cache=tmp_path).identical


def test_other_weights_under_the_same_name_are_noticed(shards: Path, tmp_path):
    folder = Path(shutil.copytree(shards, tmp_path / "policy"))
    made = run_transform(
        Depth(keep=(0, 1), include=STACK), sourced(folder, tmp_path / "in"), tmp_path / "out", Context()
    ).bundle
    first = sorted(folder.glob("*.safetensors"))[0]
    save_file({name: value + 1 for name, value in load_file(first).items()}, first)
    with pytest.raises(SourceError, match=r"have changed since .* was made"):
        load_modules(made)


CODE = """
import torch
from torch import nn

class Odd(nn.Module):
    def __init__(self):
        super().__init__()
        self.table = nn.Embedding(16, 8)
        self.norm = nn.BatchNorm1d(8)
        self.memory = nn.LSTM(8, 8, batch_first=True)
        self.out = nn.Linear(8, 16, bias=False)
        self.out.weight = self.table.weight
        self.first = nn.ModuleList(nn.Linear(8, 8) for _ in range(4))
        self.second = nn.ModuleList(nn.Linear(8, 8, bias=number % 2 == 1) for number in range(4))
        self.mixing = nn.Parameter(torch.empty(8, 8))

    def forward(self, ids):
        x = self.norm(self.table(ids)[0])
        assert self.mixing.shape == (8, 8)
        x = x @ self.mixing.T + torch.ones(8, device=self.mixing.device)
        kept = [layer(x) for layer in self.first]
        for number, layer in enumerate(self.second):
            x = x + layer(kept[number])
        x = self.memory(x[None])[0]
        return torch.nn.functional.linear(x, self.out.weight).reshape(1, 6, 16)[:, :2, :3]

def make():
    return Odd()
"""


@pytest.fixture
def odd(tmp_path) -> Bundle:
    """Tied weights, saved buffers, a recurrent layer, a weight that forward() uses itself, stacks that go together."""
    folder = tmp_path / "odd"
    folder.mkdir()
    (folder / "policy.py").write_text(CODE)
    inputs = [{"name": "ids", "shape": [1, 6], "dtype": "int64"}]
    outputs = [{"name": "action", "shape": [1, 2, 3], "unit": ["rad"] * 3}]
    spec = {"inputs": inputs, "outputs": outputs, "control_hz": 5, "chunk": 2}
    described = {"name": "odd", "source": "policy.py:make", "weights": "*.safetensors", "spec": spec}
    (folder / "policy.yaml").write_text(yaml.safe_dump(described))
    np.savez(folder / "calibration.npz", ids=np.arange(24).reshape(4, 6) % 16)
    scope: dict = {}
    exec(CODE, scope)
    torch.manual_seed(0)
    state = scope["make"]().state_dict()
    random = {name: torch.rand_like(value) if value.is_floating_point() else value for name, value in state.items()}
    del random["out.weight"]
    save_file(random, folder / "model.safetensors")
    return sourced(folder, tmp_path / "odd-source")


def test_modules_of_every_kind_run_from_shards(odd: Bundle, tmp_path):
    run = Depth(rank="even", blocks=2, include=("first", "second"))
    made = run_transform(run, odd, tmp_path / "out", Context()).bundle
    assert [edit.keep for edit in read_edits(made)] == [(0, 3), (0, 3)]
    modules = stored_modules(made)
    with weights_on_demand(modules):
        got = action(made, policy_of(made, modules.modules, 0))
    wanted = load_modules(made)["main"]
    assert wanted.table.weight is wanted.out.weight
    np.testing.assert_array_equal(got, action(made, policy_of(made, {"main": wanted}, 0)))
    stored_state = load_file(tmp_path / "odd/model.safetensors")
    assert torch.equal(wanted.norm.running_mean, stored_state["norm.running_mean"])
    assert torch.equal(wanted.second[1].weight, stored_state["second.3.weight"])
    with graph_weights(modules, "main"):
        assert torch.equal(modules.modules["main"].mixing, stored_state["mixing"])
    assert modules.modules["main"].mixing.is_meta


@pytest.mark.parametrize("limit", [0, 1 << 30])
def test_stacks_that_go_together_must_be_cut_together(odd: Bundle, tmp_path, monkeypatch, limit):
    monkeypatch.setattr(stage, "MAX_RUN_BYTES", limit)
    (tmp_path / "out").mkdir()
    with pytest.raises(SourceError, match="IndexError: list index out of range"):
        Depth(keep=(0, 1), include=("first",)).run(odd, tmp_path / "out", Context())


def test_a_stage_that_changes_weights_writes_them(pruned: Bundle, tmp_path):
    class Zeros(Neurons):
        def change(self, modules, source, context):
            with torch.no_grad():
                modules["main"].head.weight.zero_()
            return stage.ModuleChanges()

    made = Zeros().run(pruned, _new(tmp_path / "out"), Context()).bundle
    assert holds_weights(made)
    assert read_edits(made) == read_edits(pruned)
    assert not takes_shards(made)
    assert not load_modules(made)["main"].head.weight.any()


def _new(folder: Path) -> Path:
    folder.mkdir()
    return folder
