"""What parts of a policy cost in milliseconds on this machine: measured without some of them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vlatool.module.axes import Member
from vlatool.module.edits import BLOCKS, Edit
from vlatool.prune._clock import Clock
from vlatool.prune._ranking import Ranking
from vlatool.prune._units import Group, Work

LEAST_PRICE = 0.1
"""Of a multiply-accumulate, in that of the median part: below, a measurement says that it is free, or gains."""


@dataclass
class Stack:
    """Blocks one behind the other that may go as a whole.

    Args:
        places: Graph name -> name of the list of blocks, as ``named_modules`` gives it; graphs may share one list.
        blocks: Name of each block in the list, usually its number.
        importance: Of each block.
        keep: Numbers of those that stay.
        ms: What one block takes.
    """

    places: Mapping[str, str]
    blocks: Sequence[str]
    importance: Sequence[float] = ()
    keep: list[int] = field(default_factory=list)
    ms: float = 0.0

    def __post_init__(self) -> None:
        self.keep = list(range(len(self.blocks)))

    @property
    def least(self) -> int:
        """Return the block that is left and matters least."""
        return min(self.keep, key=self.importance.__getitem__)

    @property
    def home(self) -> tuple[str, str]:
        """Return the first graph that has the list, and its name there."""
        return next(iter(self.places.items()))

    def edit(self, keep: Sequence[int]) -> Edit:
        """Return what keeps some blocks; one edit cuts a list that several graphs share."""
        return Edit(*self.home, BLOCKS, tuple(keep))

    def block_of(self, graph: str, weight: str) -> int | None:
        """Return the block that a weight is in, which may be one that goes; None when it is not in one."""
        block = self._parted(graph, weight)[1]
        return self.blocks.index(block) if block else None

    def is_block_of(self, group: Group, block: int) -> bool:
        """Return whether all weights of a group are in one block."""
        return all(self.block_of(group.graph, member.weight) == block for member in group.members)

    def renamed(self, graph: str, weight: str) -> str:
        """Return the name of a weight that stays after the blocks that go are gone."""
        prefix, block, rest = self._parted(graph, weight)
        return f"{prefix}{self.keep.index(self.blocks.index(block))}.{rest}" if block.isdecimal() else weight

    def _parted(self, graph: str, weight: str) -> tuple[str, str, str]:
        """Return what is before a block's name, the block's name, and what is after it; empty for another weight."""
        prefix = prefix_of(self.places.get(graph, ""))
        block, _, rest = weight.removeprefix(prefix).partition(".")
        inside = graph in self.places and weight.startswith(prefix) and block in self.blocks and rest
        return (prefix, block, rest) if inside else ("", "", "")


def prefix_of(module: str) -> str:
    """Return what the names of a module's parts begin with; the whole policy's name is empty."""
    return f"{module}." if module else ""


def rank_blocks(stacks: Sequence[Stack], ranking: Ranking) -> None:
    """Fill in the importance of all blocks."""
    scores = ranking.gate([(*stack.home, block) for stack in stacks for block in stack.keep], set())
    for stack in stacks:
        stack.importance = [scores[(*stack.home, block)] for block in stack.keep]


def edits_of(groups: Sequence[Group], stacks: Sequence[Stack]) -> tuple[Edit, ...]:
    """Return what keeps the blocks and units that stay: blocks first, then the units of what is left.

    Blocks are numbered anew as soon as an edit is applied. Stacks that lie in blocks of others are therefore cut
    first, and units have the names that their weights have after all stacks are cut.
    """
    inner_first = sorted(stacks, key=lambda stack: -max(map(len, stack.places.values())))
    edits = [stack.edit(stack.keep) for stack in inner_first
             if len(stack.keep) < len(stack.blocks) and not is_inside_gone(stack, stacks)]  # fmt: skip
    for group in groups:
        member = staying(group, stacks)
        if member is None or group.stays == group.size:
            continue
        edit = group.edit(member)
        for stack in inner_first:
            edit = replace(edit, module=stack.renamed(edit.graph, edit.module))
        edits.append(edit)
    return tuple(edits)


def is_gone(graph: str, weight: str, stacks: Sequence[Stack]) -> bool:
    """Return whether a weight is in a block that does not stay."""
    homes = ((stack, stack.block_of(graph, weight)) for stack in stacks)
    return any(home is not None and home not in stack.keep for stack, home in homes)


def is_inside_gone(stack: Stack, stacks: Sequence[Stack]) -> bool:
    """Return whether a stack lies in a block of another one that does not stay."""
    return any(is_gone(graph, name, stacks) for graph, name in stack.places.items())


def staying(group: Group, stacks: Sequence[Stack]) -> Member | None:
    """Return the first weight of a group that is in no block that goes; None when the whole group goes with blocks."""
    return next((member for member in group.members if not is_gone(group.graph, member.weight, stacks)), None)


def role_of(group: Group) -> str:
    """Return what a group has in common with its like in other blocks: its first weight, without numbers."""
    return f"{group.graph} {re.sub(r'[0-9]+', '*', group.members[0].weight)}"


def measured_prices(
    groups: Sequence[Group], stacks: Sequence[Stack], work: Work, clock: Clock
) -> tuple[float, Mapping[str, float]]:
    """Time the policy without half of the units of each role, and without one block of each stack.

    Returns:
        Milliseconds of the whole policy, and role -> milliseconds for a multiply-accumulate. Stacks get their ``ms``.
    """
    roles = sorted({role_of(group) for group in groups})
    trials = [tuple(_halved(groups, role)) for role in roles]
    trials += [(stack.edit([block for block in stack.keep if block != stack.least]),) for stack in stacks]
    whole, times = clock.times(trials)
    for stack, ms in zip(stacks, times[len(roles) :], strict=True):
        stack.ms = max(whole - ms, 0.0)
    saved = [
        sum(work.without(number, _half(group)) for number, group in enumerate(groups) if role_of(group) == role)
        for role in roles
    ]
    prices = {role: (whole - ms) / macs for role, ms, macs in zip(roles, times, saved, strict=False) if macs}
    least = LEAST_PRICE * float(np.median([price for price in prices.values() if price > 0] or [whole / max(saved)]))
    return whole, {role: max(prices.get(role, least), least) for role in roles}


def _half(group: Group) -> int:
    return max(1, group.size // 2)


def _halved(groups: Sequence[Group], role: str) -> Iterator[Edit]:
    for group in groups:
        if role_of(group) == role and group.size > 1:
            units = tuple(sorted(np.argsort(-group.importance, kind="stable")[: _half(group)].tolist()))
            yield group.edit(keep=units)
