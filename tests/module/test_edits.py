"""Structural edits: which channels of a module stay, and what is refused."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from torch import nn

from vlatool.bundle.bundle import Bundle, seal
from vlatool.errors import SourceError
from vlatool.module.edits import (
    EDITS,
    Edit,
    apply,
    apply_bundle,
    concatenate_edits,
    is_changed,
    load_tensors,
    read_edits,
    read_tensors,
    write_module,
)
from vlatool.module.unit_removal import RETRACE


def mlp() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 6), nn.BatchNorm1d(6), nn.ReLU(), nn.Linear(6, 2)).eval()


def test_kept_channels_compute_what_zeroed_ones_do():
    whole, cut = mlp(), mlp()
    keep = (4, 0, 1)
    with torch.no_grad():
        gone = [each for each in range(6) if each not in keep]
        whole[3].weight[:, gone] = 0
    edits = [Edit("main", "0", "outputs", keep), Edit("main", "1", "outputs", keep), Edit("main", "3", "inputs", keep)]
    apply({"main": cut}, edits)
    x = torch.randn(5, 3)
    torch.testing.assert_close(cut(x), whole(x))
    assert (cut[0].out_features, cut[1].num_features, cut[3].in_features) == (3, 3, 3)
    assert cut[3].bias.shape == (2,)


def test_convolutions_are_cut_too():
    torch.manual_seed(0)
    net = nn.Sequential(nn.Conv2d(2, 4, 3), nn.Conv2d(4, 1, 1)).eval()
    x = torch.randn(1, 2, 5, 5)
    with torch.no_grad():
        net[1].weight[:, [0, 2]] = 0
        wanted = net(x)
    apply({"main": net}, [Edit("main", "0", "outputs", (1, 3)), Edit("main", "1", "inputs", (1, 3))])
    torch.testing.assert_close(net(x), wanted)


@pytest.mark.parametrize(("edit", "says"), [
    (Edit("other", "0", "outputs", (0,)), "names the graph 'other'"),
    (Edit("main", "7", "outputs", (0,)), "names the module '7'; known: 0, 1, 2, 3\\."),
    (Edit("main", "2", "outputs", (0,)), r"outputs of '2' \(ReLU\) cannot be chosen"),
    (Edit("main", "1", "inputs", (0,)), "inputs of '1'"),
    (Edit("main", "0", "outputs", (6,)), "has 6 outputs, numbered from 0; an edit keeps number 6"),
])  # fmt: skip
def test_an_edit_that_does_not_fit_is_refused(edit: Edit, says: str):
    with pytest.raises(SourceError, match=says) as caught:
        apply({"main": mlp()}, [edit])
    assert caught.value.fix.startswith("make the bundle again")


def test_grouped_convolutions_are_refused():
    with pytest.raises(SourceError, match="cannot be chosen"):
        apply({"main": nn.Sequential(nn.Conv2d(4, 4, 3, groups=2))}, [Edit("main", "0", "outputs", (0,))])


@pytest.fixture
def changed(source_bundle: Bundle, tmp_path: Path) -> Bundle:
    """A bundle with an edited module of one MLP."""
    module = mlp()
    edits = (
        Edit("main", "0", "outputs", (1, 2)),
        Edit("main", "1", "outputs", (1, 2)),
        Edit("main", "3", "inputs", (1, 2)),
    )
    apply({"main": module}, edits)
    (tmp_path / "changed").mkdir()
    write_module(tmp_path / "changed", edits, {"main": module})
    return seal(tmp_path / "changed", source_bundle.manifest)


def test_what_is_written_is_made_again(changed: Bundle):
    assert is_changed(changed)
    again = apply_bundle({"main": mlp()}, changed)["main"]
    x = torch.randn(4, 3)
    wanted = mlp()
    apply({"main": wanted}, read_edits(changed))
    torch.testing.assert_close(again(x), wanted(x))
    structure = apply_bundle({"main": mlp()}, changed, weights=False)["main"]
    assert structure[0].out_features == 2


def test_a_tied_weight_is_stored_once_and_given_to_all_of_its_names(tmp_path: Path):
    def tied() -> nn.Sequential:
        net = nn.Sequential(nn.Linear(6, 6), nn.ReLU(), nn.Linear(6, 6))
        net[2].weight = net[0].weight
        return net

    whole, again = tied(), tied()
    write_module(tmp_path, (), {"main": whole})
    tensors = read_tensors(tmp_path / "module/main.safetensors")
    assert sorted(tensors) == ["0.bias", "0.weight", "2.bias"]
    load_tensors("main", again, tensors, "a file")
    assert again[2].weight is again[0].weight
    torch.testing.assert_close(again.state_dict(), whole.state_dict())
    other = {**tensors, "2.weight": tensors.pop("0.weight")}
    other.pop("0.weight")
    load_tensors("main", tied(), other, "a file that has the other name")
    with pytest.raises(SourceError, match=r"No tensor of a file is '0\.weight'"):
        load_tensors("main", tied(), tensors, "a file")


def test_views_of_one_memory_are_stored_apart(tmp_path: Path):
    module, memory = nn.Linear(2, 3, bias=False), torch.randn(4, 2)
    module.weight = nn.Parameter(memory[:3])
    module.register_buffer("last", memory[3:])
    write_module(tmp_path, (), {"main": module})
    assert {name: tuple(value.shape) for name, value in read_tensors(tmp_path / "module/main.safetensors").items()} == {
        "weight": (3, 2), "last": (1, 2),
    }  # fmt: skip


def test_a_bundle_without_changes_has_none(source_bundle: Bundle):
    assert not is_changed(source_bundle)
    assert read_edits(source_bundle) == ()
    module = mlp()
    assert apply_bundle({"main": module}, source_bundle)["main"] is module


@pytest.mark.parametrize("edit", [
    {"graph": "main", "module": "0", "axis": "outputs", "keep": []},
    {"graph": "main", "module": "0", "axis": "outputs", "keep": [1, 1]},
    {"graph": "main", "module": "0", "axis": "outputs", "keep": [-1]},
    {"graph": "main", "module": "0", "axis": "outputs", "keep": [True]},
    {"graph": "main", "module": "0", "axis": "sides", "keep": [0]},
    {"graph": "main", "module": "0", "axis": "outputs", "keep": [0], "more": 1},
    {"graph": "main"}, 7, None,
])  # fmt: skip
def test_a_file_of_edits_that_makes_no_sense_is_refused(changed: Bundle, edit: object):
    (changed.path / EDITS).write_text(json.dumps([edit]))
    with pytest.raises(
        SourceError, match=r"an invalid edit: .*; wanted graph and module .*outputs, inputs, blocks"
    ) as it:
        read_edits(changed)
    assert it.value.fix.startswith("make the bundle again")


def test_a_file_that_is_no_list_is_refused(changed: Bundle):
    for text, says in (("{}", "must hold a list"), ("[", "not valid JSON"),
                       (f"[{'9' * 5000}]", r"not valid JSON: a number of 5000 digits\.")):  # fmt: skip
        (changed.path / EDITS).write_text(text)
        with pytest.raises(SourceError, match=says):
            read_edits(changed)


def test_weights_of_another_shape_are_refused(changed: Bundle):
    other = replace(
        changed.manifest, files={name: each for name, each in changed.manifest.files.items() if name != EDITS}
    )
    with pytest.raises(SourceError, match=r"has the shape \[2, 3\] in .*main.safetensors; the module's is \[6, 3\]"):
        apply_bundle({"main": mlp()}, Bundle(changed.path, other))


def test_a_file_that_is_not_safetensors_is_refused(changed: Bundle):
    (changed.path / "module/main.safetensors").write_bytes(b"\xff" * 64)
    with pytest.raises(SourceError, match=r"main\.safetensors cannot be read as safetensors"):
        apply_bundle({"main": mlp()}, changed)


class Pair(nn.Module):
    """Two heads, of which one may stay; and a part of a concatenation of which one unit may."""

    def __init__(self, one: bool):
        super().__init__()
        self.joint, self.out, self.other, self.last = (
            nn.Linear(6, 24),
            nn.Linear(8, 6),
            nn.Linear(6, 2),
            nn.Linear(8, 3),
        )
        self.one = one

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        assert not self.one or len(x) in (1, 3), "sizes that the code knows"
        query, key, value = (each.unflatten(-1, (2, 4)).transpose(1, 2) for each in self.joint(x).chunk(3, -1))
        mixed = (torch.softmax(query @ key.mT, -1) @ value).transpose(1, 2).flatten(2)
        return self.last(torch.cat([self.out(mixed), self.other(x)], -1)).mean(1)


@pytest.mark.parametrize("one", [False, True])
def test_units_of_what_is_left_are_those_of_another_trace(one: bool, monkeypatch: pytest.MonkeyPatch):
    """One head is no axis any more, so that the same places name other units."""
    torch.manual_seed(0)
    module, x = Pair(one).eval(), torch.randn(1, 3, 6)
    monkeypatch.setattr("vlatool.module.edits.first_feeds", lambda modules, bundle: {"main": [x]})
    before = [Edit("main", "joint.weight", "units 0.1", (1,)), Edit("main", "other.weight", "units 0.0", (0,))]
    after = [Edit("main", "joint.weight", "units 0.1", (0, 2, 3)), Edit("main", "out.weight", "units 0.0", (0, 5))]
    joined = concatenate_edits(before, after)
    assert [edit.axis for edit in joined] == ["units 0.1", "units 0.0", "units@2 0.1", "units@2 0.0"]
    assert [edit.axis for edit in concatenate_edits(joined, after[:1])][4:] == ["units@3 0.1"]
    bundle = Bundle(Path(), cast(Any, None))
    first = apply({"main": copy.deepcopy(module)}, before, bundle)
    wanted = apply(first, after, bundle)["main"]
    made = apply({"main": copy.deepcopy(module)}, joined, bundle)["main"]
    assert made.get_parameter("joint.weight").shape == (3 * 3, 6)
    torch.testing.assert_close(made(x), wanted(x))
    if one:
        batch = torch.randn(3, 3, 6)
        torch.testing.assert_close(getattr(made, RETRACE)(3)(batch), torch.cat([made(row[None]) for row in batch]))
