"""Axes as products of factors, in classes of equal ones (a union-find)."""

from __future__ import annotations

import math
from collections.abc import Iterable

Axis = tuple[int, ...]
"""Factors of an axis, the slowest one first; none for an axis of size 1."""
Shape = list[Axis]


class Factors:
    """Factors of axes, in classes of equal ones.

    Attributes:
        sizes: Of each factor.
        operator: What is being looked at; it is noted as the reason for what it freezes.
    """

    def __init__(self) -> None:
        self._above: list[int] = []
        self._parts: dict[int, Axis] = {}
        self.sizes: list[int] = []
        self._frozen: dict[int, str] = {}
        self.operator = ""

    def new(self, size: int, frozen: bool = False) -> Axis:
        """Return an axis of one factor, none for size 1."""
        if size == 1:
            return ()
        self._above.append(len(self._above))
        self.sizes.append(size)
        if frozen:
            self._frozen[len(self._above) - 1] = self.operator
        return (len(self._above) - 1,)

    def root(self, factor: int) -> int:
        """Return the factor that stands for its class."""
        while self._above[factor] != factor:
            self._above[factor] = self._above[self._above[factor]]
            factor = self._above[factor]
        return factor

    def leaves(self, axis: Iterable[int]) -> Axis:
        """Return the factors of an axis as far as they were divided, each by its root."""
        found: list[int] = []
        for factor in axis:
            root = self.root(factor)
            found += self.leaves(self._parts[root]) if root in self._parts else [root]
        return tuple(found)

    def size(self, axis: Iterable[int]) -> int:
        """Return the size of an axis."""
        return math.prod(self.sizes[factor] for factor in self.leaves(axis))

    def is_frozen(self, factor: int) -> bool:
        """Say whether elements of a leaf must stay."""
        return self.root(factor) in self._frozen

    def reason(self, factor: int) -> str:
        """Return the operator that a leaf was frozen by first; empty for one whose elements may go."""
        return self._frozen.get(self.root(factor), "")

    def freeze(self, axis: Iterable[int]) -> None:
        """Let all elements of an axis stay."""
        for leaf in self.leaves(axis):
            self._frozen.setdefault(leaf, self.operator)

    def divide(self, leaf: int, slow: int) -> None:
        """Divide a leaf into a factor of size ``slow`` and the rest, which turns faster."""
        parts = self.new(slow) + self.new(self.sizes[leaf] // slow)
        if leaf in self._frozen:
            self._frozen |= dict.fromkeys(parts, self._frozen[leaf])
        self._parts[leaf] = parts

    def parted(self, axis: Iterable[int], slow: int) -> tuple[Axis, Axis]:
        """Return a part of size ``slow`` and the rest, which turns faster; frozen where an axis is divided otherwise.

        Raises:
            ValueError: when its size is no multiple of that.
        """
        size, leaves = self.size(axis), list(self.leaves(axis))
        if size % slow:
            raise ValueError(f"{size} elements are no multiple of {slow}")
        first = self.taken(leaves, slow)
        if first is not None:
            return first, tuple(leaves)
        self.freeze(axis)
        return self.new(slow, frozen=True), self.new(size // slow, frozen=True)

    def unite(self, one: Axis, other: Axis) -> None:
        """Let two axes of equal size be the same; where they are divided otherwise, as far as can be, else freeze."""
        ours, theirs = list(self.leaves(one)), list(self.leaves(other))
        while ours and theirs:
            if ours[0] == theirs[0]:
                ours, theirs = ours[1:], theirs[1:]
                continue
            small, large = sorted((ours, theirs), key=lambda leaves: self.sizes[leaves[0]])
            if self.sizes[small[0]] == self.sizes[large[0]]:
                self._join(ours[0], theirs[0])
                ours, theirs = list(self.leaves(ours[1:])), list(self.leaves(theirs[1:]))
            elif self.sizes[large[0]] % self.sizes[small[0]] == 0:
                self.divide(large[0], self.sizes[small[0]])
                ours, theirs = list(self.leaves(ours)), list(self.leaves(theirs))
            else:
                break
        self.freeze((*ours, *theirs))

    def _join(self, one: int, other: int) -> None:
        self._above[other] = one
        if other in self._frozen:
            self._frozen.setdefault(one, self._frozen[other])

    def taken(self, leaves: list[int], size: int) -> Axis | None:
        """Take factors from the front of a list until they have a size; divide the last one; None where none fits."""
        taken: list[int] = []
        while size > 1:
            if not leaves:
                return None
            first = leaves[0]
            if size % self.sizes[first] == 0:
                size //= self.sizes[first]
                taken.append(leaves.pop(0))
            elif self.sizes[first] % size == 0:
                self.divide(first, size)
                leaves[:1] = self.leaves((first,))
            else:
                return None
        return tuple(taken)
