"""Matching of a student's blocks with a teacher's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vlatool.bundle.bundle import Bundle
from vlatool.module.blocks import block_names, stacks
from vlatool.module.edits import BLOCKS, Edit, loses_units, read_edits
from vlatool.module.torch_policy import unedited_modules
from vlatool.training.taps import BlockName
from vlatool.training.teacher import Teacher

if TYPE_CHECKING:
    from torch import nn

Stack = tuple[str, str]
"""Blocks one behind the other: their graph and the name of the list."""


@dataclass(frozen=True)
class Pair:
    """A block of the student and the teacher's that it is compared with, and the numbers of both."""

    stack: Stack
    numbers: tuple[int, int]
    ours: BlockName
    theirs: BlockName


def pairs_of(modules: Mapping[str, nn.Module], source: Bundle, teacher: Teacher) -> list[Pair]:
    """Return the pairs of all stacks of the same name in the student's ``modules`` and the teacher's."""
    edits, found = read_edits(source), list[Pair]()
    same_factory = teacher.bundle.manifest.source == source.manifest.source
    for graph, name in _stacks_of(teacher, edits):
        ours = block_names(modules[graph], name) if graph in modules else []
        theirs = block_names(teacher.program.modules[graph], name)
        whole = same_factory and kept_blocks(teacher.edits, (graph, name)) is None
        kept = kept_blocks(edits, (graph, name)) if whole else None
        for number, other in enumerate(teacher_blocks(len(ours), len(theirs), kept) if theirs else ()):
            found.append(Pair((graph, name), (number, other), (graph, ours[number]), (graph, theirs[other])))
    return found


def teacher_blocks(count: int, of: int, kept: Sequence[int] | None = None) -> list[int]:
    """Return which of a teacher's blocks each of a student's is compared with.

    Where blocks were removed, one that stays does what followed it as well: it is compared with the last block before
    the next one that stays. Otherwise it is the one at the same share of the depth (TinyBERT, arXiv 1909.10351, maps
    layers so: ``g(m) = m N / M``).

    Args:
        count: number of the student's blocks.
        of: number of the teacher's blocks.
        kept: indices of the teacher's blocks that the student's are, if known.

    Example:
        >>> teacher_blocks(3, 6), teacher_blocks(3, 6, (0, 1, 4))
        ([1, 3, 5], [0, 3, 5])
    """
    if kept is not None and len(kept) == count and list(kept) == sorted(kept) and kept[-1] < of:
        return [following - 1 for following in (*kept[1:], of)]
    return [max(1, (2 * (number + 1) * of + count) // (2 * count)) - 1 for number in range(count)]


def kept_blocks(edits: Iterable[Edit], stack: Stack) -> tuple[int, ...] | None:
    """Return which blocks of a stack stay after all edits, numbered as the factory makes them; None when all do."""
    kept: tuple[int, ...] | None = None
    for edit in edits:
        if (edit.graph, edit.module, edit.axis) == (*stack, BLOCKS):
            kept = edit.keep if kept is None else tuple(kept[index] for index in edit.keep)
    return kept


def _stacks_of(teacher: Teacher, edits: Sequence[Edit]) -> list[Stack]:
    """Return the stacks of a teacher, and what else lost blocks; one that several graphs share is the first one's."""
    own = teacher.program.modules
    modules = unedited_modules(teacher.bundle) if loses_units(teacher.edits) else own  # traced ones have no lists
    found: dict[int, Stack] = {}
    for graph, module in modules.items():
        parts = dict(module.named_modules())
        cut = {edit.module for edit in (*edits, *teacher.edits) if edit.graph == graph and edit.axis == BLOCKS}
        for name in [name for name, _ in stacks(module)] + sorted(cut & set(parts)):
            found.setdefault(id(parts[name]), (graph, name))
    return list(found.values())
