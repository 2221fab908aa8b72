"""Depth pruning: which blocks go, by which measure, and what is protected."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from _tiny import deepen
from safetensors.torch import load_file, save_file
from torch import nn

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import BundleError, RecipeError, SourceError
from vlatool.module.edits import Edit, apply
from vlatool.prune._selection import Selection
from vlatool.prune.depth import PROTECTED_WORDS, Depth, evenly_spaced
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

SIZES = (3.0, 0.001, 0.5, 0.05)
"""How much each block adds."""


class Residual(nn.Module):
    def __init__(self, size: float):
        super().__init__()
        self.linear = nn.Linear(16, 16)
        self.size = size

    def forward(self, tokens):
        return tokens + self.size * torch.tanh(self.linear(tokens))


class Net(nn.Module):
    def __init__(self, name: str = "trunk"):
        super().__init__()
        torch.manual_seed(1)
        self.state = nn.Linear(3, 16)
        setattr(self, name, nn.ModuleList(Residual(size) for size in SIZES))
        self.head = nn.Linear(16, 8)
        self.name = name

    def forward(self, image, proprio, instruction):
        tokens = self.state(proprio)
        for block in getattr(self, self.name):
            tokens = block(tokens)
        return self.head(tokens).reshape(1, 4, 2)


@pytest.mark.parametrize("rank", ["error", "gate", "cosine"])
def test_what_adds_least_goes_first(source_bundle: Bundle, rank: str):
    def kept(**options):
        stage = Depth(rank=rank, samples=4, **options)
        return stage.change({"main": Net().eval()}, source_bundle, Context()).edits

    assert kept(blocks=3) == (Edit("main", "trunk", "blocks", (0, 2, 3)),)
    assert kept(ratio=0.5) == (Edit("main", "trunk", "blocks", (0, 2)),)
    assert kept(blocks=1) == (Edit("main", "trunk", "blocks", (0,)),)


def test_the_modules_are_as_they_were_after_ranking(source_bundle: Bundle):
    module = Net().eval()
    feeds = [torch.zeros(1), torch.ones(1, 3), torch.zeros(1)]
    before = module(*feeds)
    Depth(samples=2).change({"main": module}, source_bundle, Context())
    assert torch.equal(module(*feeds), before)


def test_a_block_that_is_removed_is_gone():
    whole, cut = Net().eval(), Net().eval()
    with torch.no_grad():
        whole.trunk[1].size = whole.trunk[3].size = 0.0
    apply({"main": cut}, [Edit("main", "trunk", "blocks", (0, 2))])
    feeds = [torch.zeros(1), torch.ones(1, 3), torch.zeros(1)]
    assert torch.allclose(cut(*feeds), whole(*feeds))
    assert [name for name, _ in cut.trunk.named_children()] == ["0", "1"]


def test_what_sees_and_acts_is_protected_unless_it_is_named(source_bundle: Bundle):
    modules = {"main": Net("action_expert").eval()}
    with pytest.raises(RecipeError, match=r"has no other stack of blocks: action_expert \(4\)"):
        Depth(samples=2).change(modules, source_bundle, Context())
    chosen = Depth(samples=2, include=("action_expert",)).change(modules, source_bundle, Context()).edits
    assert len(chosen[0].keep) == 2
    parts = {"action_head": ["trunk2", "trunk2.*"], "fusion": ["trunk3"]}
    of_parts = Selection.protecting(PROTECTED_WORDS, parts)
    assert of_parts.protects("trunk2")
    assert of_parts.protects("trunk2.blocks")
    assert not of_parts.protects("trunk3")
    assert not of_parts.selects(("trunk2.blocks",))
    assert Selection(("trunk2.blocks",), (), PROTECTED_WORDS, of_parts.parts).selects(("trunk2.blocks",))
    protects = Selection((), (), PROTECTED_WORDS).protects
    assert protects("model.lm_expert.layers")
    assert protects("model.vision_tower.layers")
    assert protects("ActionHead.blocks")
    assert not protects("fusion")
    assert not protects("language_model.layers")


@pytest.mark.parametrize(("options", "says"), [
    ({"include": ("trunck",)}, "No stack of blocks matches 'trunck'; did you mean 'trunk'"),
    ({"exclude": ("*",)}, "has no other stack of blocks"),
    ({"ratio": 0.1}, r"--ratio 0.1 removes no block of trunk \(4\)"),
    ({"blocks": 4}, r"--blocks 4 removes no block"),
    ({"blocks": 9}, r"--blocks 9 removes no block"),
])  # fmt: skip
def test_wrong_options_are_told(source_bundle: Bundle, options: dict[str, object], says: str):
    with pytest.raises(RecipeError, match=says):
        build_stage("prune.depth", {"samples": 1, **options}).change({"main": Net()}, source_bundle, Context())


def kept(modules: dict[str, nn.Module], source: Bundle, **options: object) -> list[tuple[str, str, tuple[int, ...]]]:
    stage = build_stage("prune.depth", options)
    stage.check(source, None)
    return [(edit.graph, edit.module, edit.keep) for edit in stage.change(modules, source, Context()).edits]


@pytest.mark.parametrize(("keep", "stay"), [((3, 0), (0, 3)), ("1,2", (1, 2)), (" 0, 1 ,3", (0, 1, 3)), ([2], (2,))])
def test_blocks_that_are_named_stay(source_bundle: Bundle, keep: object, stay: tuple[int, ...]):
    assert kept({"main": Net()}, source_bundle, keep=keep) == [("main", "trunk", stay)]


@pytest.mark.parametrize(("size", "count", "numbers"), [
    (4, 1, [0]), (4, 2, [0, 3]), (5, 3, [0, 2, 4]), (16, 8, [0, 2, 4, 6, 9, 11, 13, 15]), (3, 3, [0, 1, 2]),
])  # fmt: skip
def test_even_keeps_both_ends(size: int, count: int, numbers: list[int]):
    assert evenly_spaced(size, count) == numbers


def test_even_takes_no_run(source_bundle: Bundle):
    modules = {"main": Net().to("meta")}
    assert kept(modules, source_bundle, rank="even") == [("main", "trunk", (0, 3))]
    assert kept(modules, source_bundle, rank="even", blocks=3) == [("main", "trunk", (0, 2, 3))]


def test_lists_of_several_kinds_are_taken_when_they_are_named(source_bundle: Bundle):
    net = Net()
    net.turns = nn.ModuleList(nn.Linear(2, 2) if number % 2 else nn.Identity() for number in range(6))
    modules = {"main": net}
    assert kept(modules, source_bundle, rank="even") == [("main", "trunk", (0, 3))]
    assert kept(modules, source_bundle, rank="even", include=("turns",)) == [("main", "turns", (0, 3, 5))]
    with pytest.raises(RecipeError, match="No stack of blocks matches 'turns'"):
        kept(modules, source_bundle, include=("turns",))


def test_stacks_in_blocks_of_a_stack_are_cut_before_it(source_bundle: Bundle):
    class Stages(Net):
        def __init__(self):
            super().__init__()
            self.trunk = nn.ModuleList(nn.Sequential(Residual(size), Residual(0.01)) for size in SIZES)

    made = apply({"main": Stages()}, Depth(samples=1).change({"main": Stages().eval()}, source_bundle, Context()).edits)
    assert [len(stage) for stage in made["main"].trunk] == [1, 1]


def test_a_stack_that_graphs_share_is_cut_once(source_bundle: Bundle):
    one, other = Net(), Net()
    other.trunk = one.trunk
    assert kept({"one": one, "other": other}, source_bundle, keep="0,1") == [("one", "trunk", (0, 1))]


@pytest.mark.parametrize(("options", "says"), [
    ({"keep": ""}, "keep = .*at least 1 item"),
    ({"keep": []}, "keep = .*at least 1 item"),
    ({"keep": "a"}, "keep.0 = 'a': .*integer"),
    ({"keep": "0,1.5"}, "keep.1 = '1.5': .*integer"),
    ({"keep": [True]}, "not a truth value"),
    ({"keep": 3}, "keep = 3: .*tuple"),
    ({"keep": "0,0"}, "names a block twice: 0,0"),
    ({"keep": "0,4"}, r"names block 4; trunk \(4\) has the blocks 0 to 3"),
    ({"keep": "-1"}, "names block -1"),
    ({"keep": "3,2,1,0"}, "names all blocks"),
    ({"keep": "0", "blocks": 2}, "--keep excludes --blocks"),
    ({"keep": "0", "ratio": 0.25, "rank": "even"}, "--keep excludes --ratio and --rank"),
    ({"keep": "0", "include": ("*",)}, r"these differ: trunk \(4\), more \(3\)"),
    ({"rank": "even", "ratio": 0.1}, "--ratio 0.1 removes no block"),
])  # fmt: skip
def test_wrong_blocks_to_keep_are_told(source_bundle: Bundle, options: dict[str, object], says: str):
    net = Net()
    net.more = nn.ModuleList(nn.Linear(3, 3) for _ in range(3))
    with pytest.raises(RecipeError, match=says):
        kept({"main": net}, source_bundle, **{"include": ("trunk",), **options})


def test_without_a_stack_widths_are_proposed(source_bundle: Bundle, float_bundle: Bundle, tmp_path: Path):
    with pytest.raises(RecipeError, match="has no stack of blocks") as caught:
        run_transform(Depth(), source_bundle, tmp_path / "out", Context())
    assert "vlatool prune neurons" in caught.value.fix
    with pytest.raises(BundleError, match="has no torch modules"):
        run_transform(Depth(), float_bundle, tmp_path / "out", Context())


def test_a_block_that_changes_shapes_is_named(source_bundle: Bundle):
    class Growing(nn.Module):
        def __init__(self):
            super().__init__()
            self.linear = nn.Linear(1, 1)

        def forward(self, tokens):
            return torch.cat([tokens, tokens[:, :1]], 1)

    class Grown(Net):
        def __init__(self):
            super().__init__()
            self.trunk = nn.ModuleList(Growing() for _ in range(2))
            self.head = nn.Linear(18, 8)

    assert observations_for(source_bundle, 1)
    with pytest.raises(SourceError, match=r"A block maps \[1, 16\] to \[1, 17\]"):
        Depth(samples=1).change({"main": Grown().eval()}, source_bundle, Context())


def test_how_many_blocks_stay_is_said(source_bundle: Bundle):
    said = [
        Depth(samples=4, **options).change({"main": Net().eval()}, source_bundle, Context()).messages
        for options in ({"blocks": 1}, {"keep": (0, 2)})
    ]
    assert said == [("kept 1 of 4 blocks of trunk: 0",), ("kept 2 of 4 blocks of trunk: 0, 2",)]


def test_the_guide_names_all_that_is_protected():
    guide = (Path(__file__).parents[2] / "docs/guides/prune-and-fine-tune.md").read_text()
    assert f"({', '.join(PROTECTED_WORDS)})" in " ".join(guide.split())


def test_weights_that_are_not_finite_are_blamed_and_not_the_observation(policy_dir: Path, tmp_path: Path):
    deepen(policy_dir)
    weights = load_file(str(policy_dir / "weights.safetensors"))
    weights["blocks.0.norm.bias"][3:5] = torch.nan
    save_file(weights, str(policy_dir / "weights.safetensors"))
    source = run_transform(TorchModule(policy=policy_dir), None, tmp_path / "source", Context()).bundle
    says = r"weight 'blocks\.0\.norm\.bias' of 'main' is not finite in 2 of 16 values"
    with pytest.raises(SourceError, match=says):
        run_transform(Depth(keep=(0,)), source, tmp_path / "out", Context())
