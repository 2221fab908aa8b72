"""A module that loses units, held against the whole one whose weights for these units are zero."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from vlatool.module.axes import Member, Walk
from vlatool.module.unit_removal import RETRACE, remove_units, trace_module
from vlatool.prune._selection import Selection
from vlatool.prune._unit_groups import Rank, UnitGroup, find_groups, rank_units
from vlatool.prune.structured import Structured
from vlatool.stage.base import Context

SAME = 1e-5


def silence(module: nn.Module, member: Member, gone: Collection[int]) -> None:
    """Let units of one axis of a weight do nothing; the direction of a normalised weight has no length to lose."""
    if member.weight.endswith("original1"):
        return
    places = [place for place, unit in enumerate(member.numbers) if unit in gone]
    with torch.no_grad():
        module.state_dict()[member.weight].index_fill_(member.axis, torch.tensor(places), 0.0)


def silenced(module: nn.Module, groups: Sequence[UnitGroup]) -> nn.Module:
    """Return a copy in which the units that do not stay do nothing."""
    silent = copy.deepcopy(module)
    for group in groups:
        gone = set(range(group.size)) - set(group.keep)
        for member in group.members if gone else ():
            silence(silent, member, gone)
    return silent


def counted(module: nn.Module, feeds: Sequence[Tensor]) -> int:
    """Return the multiply-accumulates as torch counts them, where no operator is a fused one: with gradients."""
    counter = FlopCounterMode(display=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of graphics cards that are not there
        with torch.backends.mkldnn.flags(enabled=False), sdpa_kernel(SDPBackend.MATH), counter:
            module(*feeds)
    return int(counter.get_total_flops()) // 2


def assert_same(given: Any, wanted: Any, what: str) -> None:
    """Compare tensors, to a share of the largest number."""
    most = SAME * max(1.0, float(wanted.abs().max()))
    torch.testing.assert_close(given, wanted, rtol=0, atol=most, msg=lambda text: f"{what}: {text}")


def check_pruned(
    module: nn.Module, feeds: Sequence[Tensor], what: str = "", rank: Rank = "random", ratio: float = 0.3
) -> Mapping[str, Any]:
    """Prune a module as the stage does; compare what is left and its work; return what the stage says.

    Args:
        module: With a batch of 1, and for a larger one where it takes any.
        feeds: Its inputs.
        what: Its name.
        rank: How units are ranked.
        ratio: Share of the work that is to go.
    """
    walks = {"main": Walk(trace_module(module.eval(), feeds))}
    groups = find_groups(walks, Selection((), ()), 2, what)
    rank_units(groups, rank, {"main": module}, None, 0)  # type: ignore[arg-type]
    done = Structured(ratio=ratio, multiple=2, least=0.2).choose(walks, groups, {"main": 1}, Context())
    small = remove_units(copy.deepcopy(module), feeds, done.edits) if done.edits else module
    silent = silenced(module, groups)
    others = [[_other(feed, size) for feed in feeds] for size in ((1,) if hasattr(small, RETRACE) else (1, 3))]
    with torch.no_grad():
        for each in (feeds, *others):
            assert_same(small(*each), silent(*each), what)
    record: Mapping[str, Any] = done.record["pruned"]
    reached = 1 - counted(small, feeds) / counted(module, feeds)
    assert abs(reached - record["reached"]) <= 0.02, f"{what}: {reached} is reached, said is {record['reached']}"
    return record


def _other(feed: Tensor, size: int) -> Tensor:
    shape = (size, *feed.shape[1:])
    return torch.randn(shape) if feed.is_floating_point() else feed[:1].expand(shape)
