"""Structured pruning: as much work goes as was asked for, the least important units first; what is left is exported."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from _pruned import counted
from torch import nn

from vlatool.boards.torch_workload import torch_workload
from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.data import recorded_observations
from vlatool.distill.policy import PolicyDistillation
from vlatool.errors import BundleError, FallsShort, RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.graph.workload import workload
from vlatool.module.axes import Walk
from vlatool.module.edits import read_edits
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.module.unit_removal import remove_units, trace_module
from vlatool.prune._selection import Selection
from vlatool.prune._unit_groups import find_groups, rank_units
from vlatool.prune.structured import Structured
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.controls import reservations
from vlatool.stage.run import run_transform

FINE = {"samples": 4, "multiple": 1}


def actions(policy, bundle: Bundle) -> np.ndarray:
    return np.stack([policy.infer(each).outputs["action"] for each in recorded_observations(bundle, 8)])


@pytest.fixture(scope="module")
def pruned(source_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy with a third less work; read only."""
    return run_transform(
        Structured(ratio=0.3, **FINE), source_bundle, tmp_path_factory.mktemp("s") / "out", Context()
    ).bundle


def work(bundle: Bundle) -> int:
    return sum(workload(bundle).graphs["main"].macs.values())


def test_as_much_work_goes_as_was_asked_and_the_export_is_made_again(
    pruned: Bundle, source_bundle: Bundle, float_bundle: Bundle, policy_template: Path, tmp_path: Path
):
    made = run_transform(ExportOnnx(), pruned, tmp_path / "out", Context()).bundle
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
    again = run_transform(Structured(ratio=0.1, **FINE), pruned, tmp_path / "again", Context()).bundle
    before, after = read_edits(pruned), read_edits(again)
    assert {(edit.module, edit.axis) for edit in after} >= {(edit.module, edit.axis) for edit in before}
    assert len({(edit.module, edit.axis) for edit in after}) == len(after)
    assert load_modules(again)["main"] is not None
    assert {edit.trace for edit in before} == {1}
    assert {edit.trace for edit in after[len(before) :]} == {2}


@pytest.mark.parametrize(("stage", "says"), [
    ("prune.depth", "lists of blocks cannot be found"), ("prune.neurons", "hidden layers of an nn.Sequential cannot"),
])  # fmt: skip
@pytest.mark.parametrize("include", [(), ("blocks",)])
def test_what_looks_for_classes_is_refused_afterwards_with_the_order_that_works(
    pruned: Bundle, tmp_path: Path, stage: str, says: str, include: tuple[str, ...]
):
    with pytest.raises(RecipeError, match=f"lost heads, neurons or channels before: it is a trace.*{says}") as caught:
        run_transform(build_stage(stage, {"include": include}), pruned, tmp_path / "out", Context())
    assert f"run vlatool {stage.replace('.', ' ')} first" in caught.value.fix


def test_it_is_trained_further(pruned: Bundle, source_bundle: Bundle, tmp_path: Path):
    stage = PolicyDistillation(
        steps=40, batch=8, episodes=0, student_episodes=0, learning_rate=0.003, average=0.9, threads=1
    )
    made = run_transform(stage, pruned, tmp_path / "out", Context()).bundle
    wanted = actions(torch_policy(source_bundle, 0), source_bundle)
    before, after = (relative_error(actions(torch_policy(each, 0), source_bundle), wanted) for each in (pruned, made))
    assert after < before


@pytest.mark.parametrize(("options", "says"), [
    ({"include": ("blok*",)}, r"No weight that can be pruned matches 'blok\*'"),
    ({"exclude": ("*",)}, "has no heads, neurons or channels that can be removed"),
])  # fmt: skip
def test_wrong_options_are_told(source_bundle: Bundle, tmp_path: Path, options: dict[str, object], says: str):
    stage = build_stage("prune.structured", {"rank": "magnitude", **options})
    with pytest.raises(RecipeError, match=says):
        stage.change(load_modules(source_bundle), source_bundle, Context())


def test_a_result_that_falls_short_is_refused_by_name(source_bundle: Bundle, tmp_path: Path):
    stage = Structured(ratio=0.95, rank="magnitude", **FINE)
    with pytest.raises(
        FallsShort, match=r"Asked for 95.0% less work; no more than \d+.\d% .* aten.embedding \(\d"
    ) as it:
        run_transform(stage, source_bundle, tmp_path / "out", Context())
    assert it.value.fix.startswith("ask for less: --ratio 0.")
    assert not (tmp_path / "out").exists()


def test_what_was_asked_and_reached_is_said_and_recorded(pruned: Bundle, source_bundle: Bundle, tmp_path: Path):
    result = run_transform(Structured(ratio=0.1, rank="magnitude", **FINE), pruned, tmp_path / "again", Context())
    again = result.bundle
    record = again.manifest.made_by["pruned"]
    assert (record["asked"], record["without_rule"]) == (0.1, [])
    assert 0.09 <= record["reached"] <= 0.15
    assert record["reached"] == round(1 - record["macs"][1] / record["macs"][0], 4)
    assert f"asked for 10.0% less work, reached {record['reached']:.1%} (" in result.messages[0]
    assert [line.split(",")[0] for line in reservations(again)] == [
        f"prune.structured: asked for {asked}% less work" for asked in ("30.0", "10.0")
    ]


@pytest.mark.parametrize(("ratio", "stays"), [(0.25, 12), (0.3, 8), (0.28, 8)])
def test_a_step_that_is_too_much_is_put_back_where_nearly_enough_is_gone(ratio: float, stays: int):
    """Each step takes a quarter of 96 in 100: 24 are nearly 25 enough, 48 are nearly twice of it."""
    module = nn.Sequential(nn.Linear(3, 16, bias=False), nn.Linear(16, 3, bias=False), nn.Linear(3, 1), nn.Linear(1, 1))
    walks = {"main": Walk(trace_module(module, [torch.randn(1, 3)]))}
    groups = find_groups(walks, Selection(("0.weight",), ()), 4, "steps")
    Structured(ratio=ratio, multiple=4).choose(walks, groups, {"main": 1}, Context())
    assert groups[0].remaining == stays


BLOCKED = """
import torch
from torch import nn


class Blocked(nn.Module):
    def __init__(self):
        super().__init__()
        self.one, self.two = nn.Linear(6, 32), nn.Linear(32, 2)

    def forward(self, state):
        return self.two(torch.cummax(self.one(state), -1)[0]).reshape(-1, 1, 2)


make = Blocked
"""
BLOCKED_YAML = """
schema: 1
name: blocked
version: 1.0.0
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 6], dtype: float32}]
  outputs: [{name: action, shape: [1, 1, 2], dtype: float32}]
  control_hz: 10
  chunk: 1
"""


def test_the_command_line_ends_with_5_and_names_what_blocks(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "policy.py").write_text(BLOCKED)
    (tmp_path / "policy.yaml").write_text(BLOCKED_YAML)
    words = ["prune", "structured", str(tmp_path), "-o", str(tmp_path / "out"), "--rank", "magnitude", "--json"]
    with pytest.raises(SystemExit) as left:
        main(words)
    error = json.loads(capsys.readouterr().out)["error"]
    assert (left.value.code, error["type"], error["exit_code"]) == (5, "FallsShort", 5)
    assert "no more than 0.0%" in error["message"]
    assert "aten.cummax (100.0%)" in error["message"]
    assert not (tmp_path / "out").exists()


def test_what_has_graphs_cannot_be_pruned(float_bundle: Bundle, tmp_path: Path):
    with pytest.raises(BundleError, match="has no torch modules"):
        run_transform(Structured(), float_bundle, tmp_path / "out", Context())


class Experts(nn.Module):
    """The two best of four experts, as one sum over all of them."""

    def __init__(self):
        super().__init__()
        self.gate, self.up, self.down = nn.Linear(8, 4), torch.randn(4, 8, 24), torch.randn(4, 24, 8)
        self.up, self.down = nn.Parameter(self.up), nn.Parameter(self.down)
        self.hidden, self.out = nn.Linear(8, 16), nn.Linear(16, 3)

    def forward(self, x):
        gates = torch.softmax(self.gate(x), -1)
        best, which = gates.topk(2, -1)
        gates = torch.zeros_like(gates).scatter(-1, which, best)
        each = torch.einsum("bteh,ehd->bted", torch.einsum("btd,edh->bteh", x, self.up).relu(), self.down)
        return self.out(self.hidden((x + (gates[..., None] * each).sum(2)).mean(1)).relu())


class Grouped(nn.Module):
    """A residual around a convolution in groups, which go as a whole."""

    def __init__(self):
        super().__init__()
        self.first, self.grouped = nn.Conv2d(3, 16, 3, padding=1), nn.Conv2d(16, 16, 3, padding=1, groups=4)
        self.wide, self.out = nn.Conv2d(16, 24, 1), nn.Linear(24, 3)

    def forward(self, x):
        x = self.first(x).relu()
        return self.out(self.wide(x + self.grouped(x).relu()).relu().mean((2, 3)))


@pytest.mark.parametrize(("make", "shape", "nearly"), [
    (Experts, (1, 4, 8), 0.35), (Grouped, (1, 3, 6, 6), 0.27),
])  # fmt: skip
def test_what_is_said_of_experts_and_groups_is_what_is_reached(
    make: type[nn.Module], shape: tuple[int, ...], nearly: float
):
    """Whether the last step stays, or is put back because nearly enough is gone without it."""
    torch.manual_seed(0)
    module, feed = make().eval(), torch.randn(shape)
    walks, whole = {"main": Walk(trace_module(module, [feed]))}, counted(module, [feed])
    said = {}
    for ratio in (nearly, 0.45, 0.9):
        groups = find_groups(walks, Selection((), ()), 8, make.__name__)
        rank_units(groups, "random", {"main": module}, source=None, samples=0)  # type: ignore[arg-type]
        done = Structured(ratio=ratio, multiple=8).choose(walks, groups, {"main": 1}, Context())
        left = counted(remove_units(copy.deepcopy(module), [feed], done.edits), [feed])
        assert done.record["pruned"]["macs"] == [whole, left]
        said[ratio] = done.record["pruned"]["reached"]
        assert said[ratio] == round(1 - left / whole, 4)
    assert 0.9 * nearly < said[nearly] < nearly, "put back"
    assert said[0.45] >= 0.45
    assert said[0.9] < 0.9 * 0.9, "which is refused"
