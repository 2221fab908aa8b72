"""What parts of a policy cost in milliseconds on this machine: measured without some of them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vlatool.module.edits import BLOCKS, Edit
from vlatool.prune._clock import Clock
from vlatool.prune._units import Group, Work

LEAST_PRICE = 0.1
"""Of a multiply-accumulate, in that of the median part: below, a measurement says that it is free, or gains."""


@dataclass
class Stack:
    """Blocks one behind the other that may go as a whole.

    Args:
        graph: Name of the graph.
        name: Of the list of blocks, as ``named_modules`` gives it.
        importance: Of each block.
        keep: Numbers of those that stay.
        ms: What one block takes.
    """

    graph: str
    name: str
    importance: list[float]
    keep: list[int] = field(default_factory=list)
    ms: float = 0.0

    def __post_init__(self) -> None:
        self.keep = list(range(len(self.importance)))

    @property
    def least(self) -> int:
        """Return the block that is left and matters least."""
        return min(self.keep, key=self.importance.__getitem__)

    def block_of(self, group: Group) -> int | None:
        """Return the block that all weights of a group are in; None when they are not in one."""
        if group.graph != self.graph:
            return None
        prefix = f"{self.name}." if self.name else ""
        parts = {member.weight.removeprefix(prefix).partition(".")[0] if member.weight.startswith(prefix) else ""
                 for member in group.members}  # fmt: skip
        number = parts.pop() if len(parts) == 1 else ""
        return int(number) if number.isdecimal() else None

    def renamed(self, weight: str) -> str:
        """Return the name of a weight after the blocks that go are gone."""
        prefix = f"{self.name}." if self.name else ""
        number, dot, rest = weight.removeprefix(prefix).partition(".")
        if not weight.startswith(prefix) or not number.isdecimal() or int(number) not in self.keep:
            return weight
        return f"{prefix}{self.keep.index(int(number))}{dot}{rest}"


def edits_of(groups: Sequence[Group], stacks: Sequence[Stack]) -> tuple[Edit, ...]:
    """Return what keeps the blocks and units that stay: blocks first, then the units of what is left."""
    edits = [Edit(stack.graph, stack.name, BLOCKS, tuple(stack.keep)) for stack in stacks
             if len(stack.keep) < len(stack.importance)]  # fmt: skip
    for group in groups:
        if group.stays == group.size or is_gone(group, stacks):
            continue
        edit = group.edit()
        for stack in stacks:
            if stack.graph == edit.graph:
                edit = Edit(edit.graph, stack.renamed(edit.module), edit.axis, edit.keep)
        edits.append(edit)
    return tuple(edits)


def is_gone(group: Group, stacks: Sequence[Stack]) -> bool:
    """Return whether a group is in a block that does not stay."""
    homes = ((stack, stack.block_of(group)) for stack in stacks)
    return any(home is not None and home not in stack.keep for stack, home in homes)


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
    trials += [(Edit(stack.graph, stack.name, BLOCKS, tuple(block for block in stack.keep if block != stack.least)),)
               for stack in stacks]  # fmt: skip
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
            yield Edit(group.graph, group.members[0].weight, group.axis, units)
