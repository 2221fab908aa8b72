"""Parts of weights: what is cut and what stays whole, and that what is gathered is what was there.

A group of one process holds parts that are whole: everything but the sums is as with several.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.errors import RecipeError, SourceError
from vlatool.module.batched_program import run_module
from vlatool.module.unit_removal import RETRACE
from vlatool.training.group import Group
from vlatool.training.shards import Parts, Shards, shards_of


@pytest.fixture
def group() -> Iterator[Group]:
    torch.distributed.init_process_group("gloo", store=torch.distributed.HashStore(), rank=0, world_size=1)
    yield Group()
    torch.distributed.destroy_process_group()


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.product = nn.Linear(6, 6)
        self.gate = nn.Parameter(torch.ones(()))
        self.narrow = nn.Parameter(torch.zeros(6, dtype=torch.bfloat16))

    def forward(self, x):
        return (x + self.gate * self.product(x) + self.narrow).view(x.shape)


class Net(nn.Module):
    def __init__(self, tied=None):
        super().__init__()
        self.first = nn.Linear(3, 6)
        self.blocks = nn.ModuleList(Block() for _ in range(3))
        self.last = tied or nn.Linear(6, 2)

    def forward(self, x):
        x = self.first(x)
        for block in self.blocks:
            x = block(x)
            x += 1  # in place, on what a block gives as a view
        return self.last(x)


class Aside(nn.Module):
    """Uses a weight of a block that it does not call."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, x):
        return nn.functional.linear(x, self.net.blocks[0].product.weight)


def nets() -> tuple[nn.Module, nn.Module]:
    torch.manual_seed(0)
    net, same = Net().eval(), Net().eval()
    same.load_state_dict(net.state_dict())
    return net, same


def test_blocks_and_the_rest_are_cut_and_what_cannot_be_stays_whole(group: Group):
    net, _ = nets()
    before = {name: tuple(value.shape) for name, value in net.named_parameters()}
    shards = Parts({"main": net}, group)
    whole = {name for name, value in net.named_parameters() if not hasattr(value, "full_tensor")}
    assert whole == {f"blocks.{number}.{name}" for number in range(3) for name in ("gate", "narrow")}
    assert {name.removeprefix("main."): tuple(shards.size(name, held)) for name, held in shards.held.items()} == before
    assert all(value.requires_grad for value in shards.held.values())


def test_a_step_is_that_of_whole_weights(group: Group):
    net, same = nets()
    shards, whole = Parts({"main": net}, group), shards_of({"main": same}, group, cut=False)
    rows = torch.from_numpy(np.random.default_rng(0).standard_normal((5, 3)).astype(np.float32))
    for held, module in ((shards, net), (whole, same)):
        optimizer = torch.optim.SGD(list(held.held.values()), 1e-3)
        for _ in range(2):
            optimizer.zero_grad()
            for part in (rows[:2], rows[2:]):  # gradients of parts are added
                module(part).square().sum().backward()
            held.sum_gradients(0.0, group)
            optimizer.step()
    assert float(shards.norm(group)) == pytest.approx(float(whole.norm(group)), rel=1e-5)
    for name, value in whole.held.items():
        assert torch.allclose(shards.whole(name, shards.held[name]), value, 1e-5, 1e-6), name
        assert torch.equal(shards.part(name, value), value), name


def test_modules_hold_whole_weights_within_a_block_and_parts_after_it(group: Group):
    net, same = nets()
    shards = Parts({"main": net}, group)
    before = dict(net.named_parameters())
    with shards.in_modules(keep=True):
        held = net.state_dict()
        assert all(type(value) is torch.Tensor for value in held.values())
        assert all(torch.equal(value, held[name]) for name, value in same.state_dict().items())
    assert all(value is before[name] for name, value in net.named_parameters())
    with shards.in_modules(keep=False):
        assert all(value is before[name] for name, value in net.named_parameters())
    shards.gather(keep=True)
    assert all(torch.equal(value, net.state_dict()[name]) for name, value in same.state_dict().items())


def test_a_weight_of_two_graphs_comes_once_and_stays_whole(group: Group):
    tied = nn.Linear(6, 2)
    first, second = Net(tied), Net(tied)
    assert len(shards_of({"a": first, "b": second}, group, cut=False).held) == 2 * 14 + 2
    shards = Parts({"a": first, "b": second}, group)
    assert len(shards.held) == 2 * 14 + 2
    assert not hasattr(tied.weight, "full_tensor")
    assert hasattr(second.first.weight, "full_tensor")


def test_a_weight_used_while_its_block_does_not_run_is_told(group: Group):
    net, _ = nets()
    shards = Parts({"main": net}, group)
    step = ProgramStep("main", {"x": "x"}, {"y": "y"})
    with pytest.raises(SourceError, match=r"mixed torch.Tensor and DTensor") as caught, shards.probing_batches():
        run_module(Aside(net), step, [torch.zeros(1, 6)])
    assert "leave --shard out" in caught.value.fix


def test_a_look_that_fails_within_a_block_leaves_nothing_behind(group: Group):
    net, _ = nets()
    shards = Parts({"main": net}, group)
    with shards.probing_batches(), pytest.raises(RuntimeError):
        net.blocks[1](torch.zeros(1, 5))
    net(torch.zeros(1, 3)).sum().backward()
    shards.sum_gradients(0.0, group)
    assert all(value.grad is not None for value in shards.held.values())


def test_modules_that_are_traced_for_each_size_are_refused(group: Group):
    net, _ = nets()
    setattr(net, RETRACE, lambda size: net)
    with pytest.raises(RecipeError, match="--shard would share no weight out"):
        Parts({"main": net}, group)
    assert type(shards_of({"main": net}, group, cut=False)) is Shards
