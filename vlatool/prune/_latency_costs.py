"""Cost of the parts of a policy in milliseconds: measured by removing some of them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vlatool.module.axes import Member
from vlatool.module.edits import BLOCKS, Edit
from vlatool.prune._block_ranking import BlockRanking
from vlatool.prune._latency_meter import LatencyMeter
from vlatool.prune._unit_groups import Macs, UnitGroup

MIN_RELATIVE_COST = 0.1
"""Least cost of a multiply-accumulate relative to the median: a measurement may find it free, or even a gain."""


@dataclass
class Stack:
    """Consecutive blocks that may be removed as a whole.

    Args:
        lists: Graph name -> name of the list of blocks in ``named_modules``; graphs may share one list.
        blocks: Name of each block in the list, usually its index.
        keep: Indices of the blocks to keep.
        ms: Milliseconds of one block.
    """

    lists: Mapping[str, str]
    blocks: Sequence[str]
    importance: Sequence[float] = ()
    keep: list[int] = field(default_factory=list)
    ms: float = 0.0

    def __post_init__(self) -> None:
        self.keep = list(range(len(self.blocks)))

    @property
    def least_important(self) -> int:
        """Return the least important block of those that are kept."""
        return min(self.keep, key=self.importance.__getitem__)

    @property
    def identity(self) -> tuple[str, str]:
        """Return the first graph that has the list, and the name of the list there."""
        return next(iter(self.lists.items()))

    def edit(self, keep: Sequence[int]) -> Edit:
        """Return the edit that keeps some blocks; one edit cuts a list that several graphs share."""
        return Edit(*self.identity, BLOCKS, tuple(keep))

    def block_of(self, graph: str, weight: str) -> int | None:
        """Return the block that holds a weight, kept or not; None for a weight outside of blocks."""
        block = self._split_name(graph, weight)[1]
        return self.blocks.index(block) if block else None

    def contains(self, group: UnitGroup, block: int) -> bool:
        """Return whether all weights of a group are in one block."""
        return all(self.block_of(group.graph, member.weight) == block for member in group.members)

    def name_after_cut(self, graph: str, weight: str) -> str:
        """Return the name of a kept weight after the cut."""
        prefix, block, rest = self._split_name(graph, weight)
        return f"{prefix}{self.keep.index(self.blocks.index(block))}.{rest}" if block.isdecimal() else weight

    def _split_name(self, graph: str, weight: str) -> tuple[str, str, str]:
        """Split a weight's name into prefix, block name and rest; empty for a weight outside of the blocks."""
        prefix = prefix_of(self.lists.get(graph, ""))
        block, _, rest = weight.removeprefix(prefix).partition(".")
        inside = graph in self.lists and weight.startswith(prefix) and block in self.blocks and rest
        return (prefix, block, rest) if inside else ("", "", "")


def prefix_of(module: str) -> str:
    """Return the prefix of the names of a module's parts; empty for the whole policy."""
    return f"{module}." if module else ""


def rank_blocks(stacks: Sequence[Stack], ranking: BlockRanking) -> None:
    """Set the importance of all blocks."""
    scores = ranking.gate([(*stack.identity, block) for stack in stacks for block in stack.keep], set())
    for stack in stacks:
        stack.importance = [scores[(*stack.identity, block)] for block in stack.keep]


def keep_edits(groups: Sequence[UnitGroup], stacks: Sequence[Stack]) -> tuple[Edit, ...]:
    """Return the edits that keep the selected blocks and units: blocks first, then units of the remaining blocks.

    An edit renumbers blocks as soon as it is applied. Stacks inside blocks of other stacks are therefore cut first, and
    units are named after their weights as these are after all stacks are cut.
    """
    inner_first = sorted(stacks, key=lambda stack: -max(map(len, stack.lists.values())))
    edits = [stack.edit(stack.keep) for stack in inner_first
             if len(stack.keep) < len(stack.blocks) and not is_inside_removed(stack, stacks)]  # fmt: skip
    for group in groups:
        member = first_kept_member(group, stacks)
        if member is None or group.remaining == group.size:
            continue
        edit = group.edit(member)
        for stack in inner_first:
            edit = replace(edit, module=stack.name_after_cut(edit.graph, edit.module))
        edits.append(edit)
    return tuple(edits)


def is_removed(graph: str, weight: str, stacks: Sequence[Stack]) -> bool:
    """Return whether a weight is in a removed block."""
    blocks = ((stack, stack.block_of(graph, weight)) for stack in stacks)
    return any(block is not None and block not in stack.keep for stack, block in blocks)


def is_inside_removed(stack: Stack, stacks: Sequence[Stack]) -> bool:
    """Return whether a stack lies in a removed block of another one."""
    return any(is_removed(graph, name, stacks) for graph, name in stack.lists.items())


def first_kept_member(group: UnitGroup, stacks: Sequence[Stack]) -> Member | None:
    """Return the first weight of a group outside of removed blocks; None when all of them are in removed blocks."""
    return next((member for member in group.members if not is_removed(group.graph, member.weight, stacks)), None)


def role_of(group: UnitGroup) -> str:
    """Return the role that a group shares with its counterparts in other blocks: its first weight, without numbers."""
    return f"{group.graph} {re.sub(r'[0-9]+', '*', group.members[0].weight)}"


def measure_costs(
    groups: Sequence[UnitGroup], stacks: Sequence[Stack], work: Macs, clock: LatencyMeter
) -> tuple[float, Mapping[str, float]]:
    """Measure the policy without half of the units of each role, and without one block of each stack.

    Returns:
        Milliseconds of the unpruned policy, and role -> milliseconds for a multiply-accumulate. Sets ``ms`` of stacks.
    """
    roles = sorted({role_of(group) for group in groups})
    trials = [tuple(_halving_edits(groups, role)) for role in roles]
    trials += [(stack.edit([block for block in stack.keep if block != stack.least_important]),) for stack in stacks]
    whole, times = clock.times(trials)
    for stack, ms in zip(stacks, times[len(roles) :], strict=True):
        stack.ms = max(whole - ms, 0.0)
    saved = [
        sum(work.saved_alone(number, _half(group)) for number, group in enumerate(groups) if role_of(group) == role)
        for role in roles
    ]
    costs = {role: (whole - ms) / macs for role, ms, macs in zip(roles, times, saved, strict=False) if macs}
    median = float(np.median([cost for cost in costs.values() if cost > 0] or [whole / max(saved)]))
    floor = MIN_RELATIVE_COST * median
    return whole, {role: max(costs.get(role, floor), floor) for role in roles}


def _half(group: UnitGroup) -> int:
    return max(1, group.size // 2)


def _halving_edits(groups: Sequence[UnitGroup], role: str) -> Iterator[Edit]:
    for group in groups:
        if role_of(group) == role and group.size > 1:
            units = tuple(sorted(np.argsort(-group.importance, kind="stable")[: _half(group)].tolist()))
            yield group.edit(keep=units)
