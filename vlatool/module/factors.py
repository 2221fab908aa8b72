"""Axes as products of factors, in classes of equal ones (a union-find); a factor may be a concatenation of axes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

Axis = tuple[int, ...]
"""Factors of an axis, the slowest one first; none for an axis of size 1."""
Shape = list[Axis]


@dataclass(frozen=True)
class Atom:
    """One place in an axis that a factor has, which is neither divided nor a concatenation.

    Args:
        path: number of the factor in the axis; where that one is a concatenation, number of the segment and of the
            factor in it, and so on.
        slower: factors that it lies within, as the elements of a head lie within the heads.
        is_fastest: whether no factor lies within it.
    """

    leaf: int
    path: tuple[int, ...]
    slower: Axis
    is_fastest: bool


class Factors:
    """Factors of axes, in classes of equal ones.

    A leaf is a factor that is not divided into a product. It may be a concatenation: its segments are axes again.
    Both are what was found so far: a leaf is divided, or cut into segments, as soon as an operator says so, wherever it
    occurs.

    Attributes:
        operator: what is being looked at; it is noted as a reason for what it freezes.
    """

    def __init__(self) -> None:
        self._above: list[int] = []
        self._parts: dict[int, Axis] = {}
        self._segments: dict[int, tuple[Axis, ...]] = {}
        self.sizes: list[int] = []
        self._frozen: dict[int, set[str]] = {}
        self.operator = ""

    def new(self, size: int, frozen: bool = False) -> Axis:
        """Return an axis of one factor, none for size 1."""
        return self._new(size, {self.operator} if frozen else set())

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

    def inside(self, leaf: int) -> tuple[Axis, ...]:
        """Return the segments of a leaf; none for one that is not a concatenation."""
        return self._segments.get(leaf, ())

    def segments(self, axis: Iterable[int]) -> list[Axis]:
        """Return the axes that an axis is a concatenation of: itself where it is none.

        What turns faster than a concatenation is in each of its segments: ``(a + b) x c`` is ``a x c + b x c``.
        """
        leaves = self.leaves(axis)
        if not leaves or leaves[0] not in self._segments:
            return [leaves]
        return [piece for segment in self._segments[leaves[0]] for piece in self.segments((*segment, *leaves[1:]))]

    def atoms(self, axis: Iterable[int]) -> Iterator[Atom]:
        """Yield the factors in an axis that are neither divided nor concatenations, with their places."""
        leaves = self.leaves(axis)
        for index, leaf in enumerate(leaves):
            last = index == len(leaves) - 1
            if leaf not in self._segments:
                yield Atom(leaf, (index,), leaves[:index], last)
            for number, segment in enumerate(self.inside(leaf)):
                for atom in self.atoms(segment):
                    path, slower = (index, number, *atom.path), (*leaves[:index], *atom.slower)
                    yield Atom(atom.leaf, path, slower, last and atom.is_fastest)

    def numbers(self, axis: Iterable[int], path: Sequence[int]) -> NDArray[Any]:
        """Return for each element of an axis which element of a factor it belongs to; -1 for none."""
        leaves = self.leaves(axis)
        leaf = leaves[path[0]]
        found = np.arange(self.sizes[leaf])
        if len(path) > 1:
            segments = [np.full(self.size(segment), -1) for segment in self._segments[leaf]]
            segments[path[1]] = self.numbers(self._segments[leaf][path[1]], path[2:])
            found = np.concatenate(segments)
        before, after = self.size(leaves[: path[0]]), self.size(leaves[path[0] + 1 :])
        return np.tile(np.repeat(found, after), before)

    def elements(self, axis: Iterable[int], keep: Mapping[int, Sequence[int]]) -> NDArray[Any]:
        """Return the elements of an axis that stay; ``keep`` maps factors to theirs, and all of the others stay."""
        found = np.zeros(1, dtype=np.int64)
        for leaf in self.leaves(axis):
            chosen = np.asarray(keep.get(leaf, range(self.sizes[leaf])), dtype=np.int64)
            if segments := self.inside(leaf):
                starts = accumulate(map(self.size, segments), initial=0)
                each = [start + self.elements(segment, keep) for start, segment in zip(starts, segments, strict=False)]
                chosen = np.concatenate(each)
            found = (found[:, None] * self.sizes[leaf] + chosen[None]).reshape(-1)
        return found

    def size(self, axis: Iterable[int]) -> int:
        """Return the size of an axis."""
        return math.prod(self.sizes[factor] for factor in self.leaves(axis))

    def is_frozen(self, factor: int) -> bool:
        """Say whether all elements of a leaf must stay."""
        return all(atom.leaf in self._frozen for atom in self.atoms((factor,)))

    def reasons(self, axis: Iterable[int]) -> set[str]:
        """Return the operators that an axis was frozen by; none for one of which elements may go."""
        reasons = [self._frozen.get(atom.leaf, set()) for atom in self.atoms(axis)]
        return set().union(*reasons) if all(reasons) else set()

    def freeze(self, axis: Iterable[int]) -> None:
        """Let all elements of an axis stay."""
        self._freeze(axis, {self.operator})

    def divide(self, leaf: int, slow: int) -> None:
        """Divide a leaf into a factor of size ``slow`` and the rest, which turns faster.

        A concatenation is divided where each of its segments can be; else its elements stay.
        """
        fast = self.sizes[leaf] // slow
        segments = self._segments.pop(leaf, ())
        if segments and all(self.size(segment) % fast == 0 for segment in segments):
            divided = [self.split_axis(segment, self.size(segment) // fast) for segment in segments]
            for _, rest in divided[1:]:
                self.unite(divided[0][1], rest)
            self._parts[leaf] = self.concatenate([first for first, _ in divided]) + divided[0][1]
            return
        for segment in segments:
            self.freeze(segment)
        reasons = self._frozen.get(leaf, {self.operator} if segments else set())
        self._parts[leaf] = self._new(slow, reasons) + self._new(fast, reasons)

    def split_axis(self, axis: Iterable[int], slow: int) -> tuple[Axis, Axis]:
        """Return a part of size ``slow`` and the rest, which turns faster; frozen where an axis is divided otherwise.

        Raises:
            ValueError: when its size is not a multiple of that.
        """
        size, leaves = self.size(axis), list(self.leaves(axis))
        if size % slow:
            raise ValueError(f"{size} elements are not a multiple of {slow}")
        first = self.take_front(leaves, slow)
        if first is not None:
            return first, tuple(leaves)
        self.freeze(axis)
        return self.new(slow, frozen=True), self.new(size // slow, frozen=True)

    def concatenate(self, axes: Sequence[Axis]) -> Axis:
        """Return the axis that has the elements of several ones, one after the other."""
        full = [axis for axis in axes if self.size(axis)]
        if len(full) == 1:
            return full[0]
        size = sum(self.size(axis) for axis in full)
        if all(self.is_frozen(leaf) for axis in full for leaf in self.leaves(axis)):
            return self._new(size, set().union(*(self.reasons(axis) for axis in full)) or {self.operator})
        whole = self._new(size, set())
        self._segments[whole[0]] = tuple(full)
        return whole

    def pieces(self, axis: Axis, sizes: Sequence[int]) -> list[Axis]:
        """Cut an axis into pieces of some sizes, which are its size together."""
        if all(self.is_frozen(leaf) for leaf in self.leaves(axis)):
            reasons = self.reasons(axis) or {self.operator}
            return [self._new(size, reasons) for size in sizes]
        ends = list(accumulate(sizes))
        for end in ends:
            self._end_segment(axis, end)
        segments = self.segments(axis)
        starts = list(accumulate(map(self.size, segments), initial=0))
        inside = [[segment for start, segment in zip(starts, segments, strict=False) if end - size <= start < end]
                  for size, end in zip(sizes, ends, strict=True)]  # fmt: skip
        return [self.concatenate(piece) for piece in inside]

    def unite(self, one: Axis, other: Axis) -> None:
        """Let two axes of equal size be the same; where they are divided otherwise, as far as can be, else freeze."""
        ours, theirs = self.leaves(one), self.leaves(other)
        while ours and theirs and self.size(ours) == self.size(theirs):
            small, large = sorted((ours[0], theirs[0]), key=self.sizes.__getitem__)
            if small == large or self.sizes[small] == self.sizes[large]:
                self._join(ours[0], theirs[0])
                ours, theirs = ours[1:], theirs[1:]
            elif small in self._segments or large in self._segments:
                self._align(ours, theirs)
                return
            elif self.sizes[large] % self.sizes[small] == 0:
                self.divide(large, self.sizes[small])
            else:
                break
            ours, theirs = self.leaves(ours), self.leaves(theirs)
        self.freeze((*ours, *theirs))

    def take_front(self, leaves: list[int], size: int) -> Axis | None:
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

    def _new(self, size: int, reasons: set[str]) -> Axis:
        if size == 1:
            return ()
        factor = len(self._above)
        self._above.append(factor)
        self.sizes.append(size)
        if reasons:
            self._frozen[factor] = set(reasons)
        return (factor,)

    def _freeze(self, axis: Iterable[int], reasons: set[str]) -> None:
        for atom in self.atoms(axis):
            self._frozen.setdefault(atom.leaf, set()).update(reasons)

    def _join(self, one: int, other: int) -> None:
        """Let two leaves of equal size be one."""
        if one == other:
            return
        if one in self._segments or other in self._segments:
            self._align((one,), (other,))
            del self._segments[other]
        self._above[other] = one
        if reasons := self._frozen.pop(other, set()):
            self._freeze((one,), reasons)

    def _align(self, one: Axis, other: Axis) -> None:
        """Cut two axes of equal size at the same places, and unite their segments."""
        while offsets := self._ends(one) ^ self._ends(other):
            for offset in offsets:
                self._end_segment(one, offset)
                self._end_segment(other, offset)
        for ours, theirs in zip(self.segments(one), self.segments(other), strict=True):
            self.unite(ours, theirs)

    def _ends(self, axis: Axis) -> set[int]:
        return set(accumulate(map(self.size, self.segments(axis))))

    def _end_segment(self, axis: Iterable[int], offset: int) -> None:
        """Let a segment of an axis end at a place."""
        for segment in self.segments(axis):
            if offset < self.size(segment):
                break
            offset -= self.size(segment)
        if not offset:
            return
        first, rest = segment[0], segment[1:]
        if not rest:
            reasons = self._frozen.pop(first, set())
            self._segments[first] = self._new(offset, reasons), self._new(self.sizes[first] - offset, reasons)
            return
        before, within = divmod(offset, self.size(rest))
        for bound in (before, before + bool(within)):
            self._end_segment((first,), bound)
        self._end_segment(rest, within)
