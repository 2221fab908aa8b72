"""Stacks of blocks, by the names of their blocks in traced modules, too."""

from __future__ import annotations

import torch
from torch import nn

from vlatool.module.blocks import block_names, first, stacks
from vlatool.module.to_onnx import quiet_exporter


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(4, 4)

    def forward(self, x):
        return x + torch.relu(self.linear(x))


class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.listed = nn.ModuleList(Block() for _ in range(3))
        self.sequence = nn.Sequential(Block(), Block())

    def forward(self, x):
        for block in self.listed:
            x = block(x)
        return self.sequence(x)


def test_stacks_are_blocks_of_one_kind():
    shared = nn.Linear(2, 2)
    net = nn.ModuleDict({
        "same": nn.ModuleList(nn.Linear(2, 2) for _ in range(3)),
        "sizes": nn.ModuleList([nn.Linear(2, 2), nn.Linear(2, 3)]),
        "kinds": nn.Sequential(nn.Linear(2, 2), nn.LayerNorm(2)),
        "one": nn.ModuleList([nn.Linear(2, 2)]),
        "shared": nn.ModuleList([shared, shared]),
        "weightless": nn.Sequential(nn.ReLU(), nn.ReLU()),
    })  # fmt: skip
    assert [name for name, _ in stacks(net)] == ["same"]
    assert [name for name, _ in stacks(net, mixed=True)] == ["same", "sizes"]


def test_blocks_keep_their_names_when_a_module_is_traced():
    with quiet_exporter():
        traced = torch.export.unflatten(torch.export.export(Net(), (torch.zeros(2, 3, 4),), strict=False))
    for net in (Net(), traced):
        assert block_names(net, "listed") == ["listed.0", "listed.1", "listed.2"]
        assert block_names(net, "sequence") == ["sequence.0", "sequence.1"]
        assert block_names(net, "missing") == []
    assert not list(stacks(traced))
    assert block_names(Net().sequence, "") == ["0", "1"]


def test_a_block_hands_on_the_first_of_what_it_gives():
    assert [first(gives) for gives in (3, (3, 4), [3])] == [3, 3, 3]
