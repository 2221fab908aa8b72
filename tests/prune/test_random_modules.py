"""Structured pruning of random modules: what is left computes what the module does without the units that went."""

from __future__ import annotations

import copy
import random
import warnings

import pytest
import torch
from _full import small_or_full
from _random_modules import IMAGES, SEQUENCES, RandomModule, chosen
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from vlatool.module.axes import Member, Walk
from vlatool.module.cut import RETRACE, cut, traced
from vlatool.prune._selection import Selection
from vlatool.prune._units import groups_of, rank_units
from vlatool.prune.structured import Structured
from vlatool.stage.base import Context

DRAWS = small_or_full(4, 1000)
PARTS = 4
"""Tests that the draws are divided among."""
SAME = 1e-5


def silence(module: nn.Module, member: Member, gone: set[int]) -> None:
    """Let units of one axis of a weight do nothing; the direction of a normalised weight has no length to lose."""
    if member.weight.endswith("original1"):
        return
    weight = module.state_dict()[member.weight]
    axis = member.axis
    parts = weight.reshape(*weight.shape[:axis], *member.sizes, *weight.shape[axis + 1 :])
    weight.copy_(parts.index_fill(axis + member.place, torch.tensor(sorted(gone)), 0.0).reshape(weight.shape))


def counted(module: nn.Module, feed: torch.Tensor) -> int:
    """Return the multiply-accumulates as torch counts them, where no operator is a fused one: with gradients."""
    counter = FlopCounterMode(display=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of graphics cards that are not there
        with torch.backends.mkldnn.flags(enabled=False), sdpa_kernel(SDPBackend.MATH), counter:
            module(feed)
    return int(counter.get_total_flops()) // 2


def check(seed: int) -> None:
    """Prune one module and compare."""
    module = RandomModule(seed)
    feed = module.example(seed)
    walks = {"main": Walk(traced(module, [feed]))}
    groups = groups_of(walks, Selection((), ()), 2, f"module {seed}")
    rank_units(groups, "magnitude" if seed % 2 else "random", {"main": module}, None, 0)  # type: ignore[arg-type]
    done = Structured(ratio=0.3, multiple=2, least=0.2).choose(walks, groups, {"main": 1}, Context())
    small = cut(copy.deepcopy(module), [feed], done.edits) if done.edits else module
    silent = copy.deepcopy(module)
    with torch.no_grad():
        for group in groups:
            gone = set(range(group.size)) - set(group.keep)
            for member in group.members if gone else ():
                silence(silent, member, gone)
        for feeds in (feed, module.example(seed + 1), *([] if hasattr(small, RETRACE) else [module.example(7, 3)])):
            wanted, given = silent(feeds), small(feeds)
            most = SAME * max(1.0, float(wanted.abs().max()))
            torch.testing.assert_close(
                given, wanted, rtol=0, atol=most, msg=lambda text: f"{seed} {module.kinds}: {text}"
            )
    reached = 1 - counted(small, feed) / counted(module, feed)
    assert reached == pytest.approx(done.record["pruned"]["reached"], abs=0.02), (seed, module.kinds)


@pytest.mark.parametrize("part", range(PARTS))
def test_what_is_left_of_a_random_module_is_the_module_without_its_units(part: int):
    for seed in range(part, DRAWS, PARTS):
        check(seed)


def test_each_kind_of_block_is_drawn():
    kinds = {make for seed in range(1000) for blocks in chosen(random.Random(seed)) for make in blocks}
    assert kinds == {*IMAGES, *SEQUENCES}
