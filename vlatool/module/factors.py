"""Axes as products of factors, in classes of equal ones (a union-find)."""

from __future__ import annotations

import math
from collections.abc import Iterable

Axis = tuple[int, ...]
"""Factors of an axis, the slowest one first; none for an axis of size 1."""
Shape = list[Axis]


class Factors:
    """Factors of axes, in classes of equal ones."""

    def __init__(self) -> None:
        self._above: list[int] = []
        self._parts: dict[int, Axis] = {}
        self.sizes: list[int] = []
        self._frozen: set[int] = set()

    def new(self, size: int, frozen: bool = False) -> Axis:
        """Return an axis of one factor, none for size 1."""
        if size == 1:
            return ()
        self._above.append(len(self._above))
        self.sizes.append(size)
        if frozen:
            self._frozen.add(len(self._above) - 1)
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

    def freeze(self, axis: Iterable[int]) -> None:
        """Let all elements of an axis stay."""
        self._frozen |= set(self.leaves(axis))

    def divide(self, leaf: int, slow: int) -> None:
        """Divide a leaf into a factor of size ``slow`` and the rest, which turns faster."""
        frozen = leaf in self._frozen
        parts = self.new(slow, frozen) + self.new(self.sizes[leaf] // slow, frozen)
        self._parts[leaf] = parts

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
            self._frozen.add(one)

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
