"""Depth pruning: remove whole blocks, which is faster on every engine and keeps the shapes of all others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, field_validator

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.files.printable import amount
from vlatool.module.blocks import stacks_of
from vlatool.module.edits import BLOCKS, Edit, refuse_traced
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._block_ranking import BlockId, BlockRanking, StackId
from vlatool.prune._selection import Selection
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile

PROTECTED_WORDS = (
    "vision", "visual", "image", "vit", "encoder", "projector", "connector", "head", "decoder", "action", "expert"
)  # fmt: skip
"""Words in the names of modules whose blocks stay unless --include names them. Perception and action are less redundant
than the trunk between them: with two of its action blocks left, pi0.5 succeeds in 26 %, with as few others in 91 %
(DTR, arXiv 2606.27755)."""


class Depth(ModuleStage):
    """Remove the blocks that change the action least from stacks of equal blocks.

    ``error`` removes one block after the other, each time the one whose absence changes the actions on recorded
    observations least. ``gate`` takes one backward pass: how much the action changes when the block's contribution to
    the residual stream is scaled. ``cosine`` takes one forward pass: how little a block rotates the residual stream.
    ``even`` runs nothing: the remaining blocks are evenly spaced, including the first and the last one. Train the
    result afterwards (``vlatool distill policy`` takes it unchanged).

    Where policy.yaml names the shards of the weights, the shards are not copied; ``even``, ``cosine`` and ``--keep``
    then hold one weight in memory at a time.
    """

    keeps_weights: ClassVar[bool] = True

    ratio: float = Field(0.5, gt=0, lt=1, description="largest share of the blocks of each stack to remove")
    blocks: int | None = Field(None, ge=1, description="blocks of each stack to keep, instead of --ratio")
    keep: tuple[int, ...] | None = Field(
        None, min_length=1, description="numbers of the blocks to keep, such as 0,2,4, instead of a ranking"
    )
    rank: Literal["error", "gate", "cosine", "even"] = Field("error", description="how blocks are ranked")
    samples: int = Field(32, ge=1, description="recorded observations to rank on")
    include: tuple[str, ...] = Field((), description="globs of stacks to prune; the trunk's when empty")
    exclude: tuple[str, ...] = Field((), description="globs of stacks to leave as they are")

    @field_validator("keep", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return [part for part in value.split(",") if part.strip()] if isinstance(value, str) else value

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that only one option determines the blocks to keep."""
        super().check(source, profile)
        others = [f"--{name}" for name in ("ratio", "blocks", "rank") if name in self.options()]
        if self.keep and others:
            raise RecipeError(f"--keep excludes {' and '.join(others)}: it determines the blocks.", "use one of them")
        if self.keep and len(set(self.keep)) < len(self.keep):
            raise RecipeError(f"--keep names a block twice: {','.join(map(str, self.keep))}.", "name each block once")

    def in_parts(self) -> bool:
        """Return whether one weight at a time suffices: ``gate`` needs all, ``error`` would reload them very often."""
        return bool(self.keep) or self.rank in ("even", "cosine")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the blocks to keep.

        Raises:
            RecipeError: when there is no stack of blocks to prune, a pattern matches none, or ``keep`` does not fit.
        """
        sizes = self._selected_stacks(self._sizes(modules), source)
        explicit = _explicit_blocks(sizes, self.keep) if self.keep else {}
        remaining = explicit or self._remaining_blocks(sizes, modules, source, context)
        ranked = not explicit and self.rank != "even"
        kept_blocks = (
            f"kept {len(kept)} of {amount(sizes[graph, name], 'block')} of {name or 'the module itself'}: "
            f"{', '.join(map(str, kept))}"
            for (graph, name), kept in remaining.items()
        )
        edits = [Edit(graph, name, BLOCKS, tuple(kept)) for (graph, name), kept in remaining.items()]
        edits.sort(key=lambda edit: -len(edit.module))  # stacks within blocks first
        unrecorded = unrecorded_note(source, self.samples) if ranked else ()
        return ModuleChanges(tuple(edits), messages=(*unrecorded, *kept_blocks))

    def _sizes(self, modules: Mapping[str, nn.Module]) -> dict[StackId, int]:
        """Return the number of blocks of each stack; a shared stack belongs to its first graph."""
        mixed = bool(self.include) and (bool(self.keep) or self.rank == "even")
        return {next(iter(places.items())): len(stack) for places, stack in stacks_of(modules, mixed=mixed)}

    def _remaining_blocks(
        self, sizes: Mapping[StackId, int], modules: Mapping[str, nn.Module], source: Bundle, context: Context
    ) -> dict[StackId, list[int]]:
        """Return the remaining blocks of each stack that loses blocks."""
        removals = {stack: count for stack, size in sizes.items() if (count := self._removal_count(size)) > 0}
        if not removals:
            requested = f"--ratio {self.ratio:g}" if self.blocks is None else f"--blocks {self.blocks}"
            raise RecipeError(f"{requested} removes no block of {_list_stacks(sizes)}.", "ask for more")
        if self.rank == "even":
            return {stack: evenly_spaced(sizes[stack], sizes[stack] - count) for stack, count in removals.items()}
        ranking = BlockRanking(modules, source, self.samples)
        remaining = {stack: list(range(sizes[stack])) for stack in removals}
        for (graph, name), block in self._removal_order(ranking, remaining, removals, context):
            remaining[graph, name].remove(block)
        return remaining

    def _removal_count(self, size: int) -> int:
        """Return the number of blocks to remove from a stack; one always stays."""
        return size - self.blocks if self.blocks is not None else min(size - 1, math.floor(size * self.ratio + 1e-9))

    def _removal_order(
        self, ranking: BlockRanking, remaining: Mapping[StackId, list[int]], counts: Mapping[StackId, int],
        context: Context
    ) -> Iterator[tuple[StackId, int]]:  # fmt: skip
        """Yield the next block to remove; the caller removes it from ``remaining``."""
        rank = {"error": ranking.errors, "cosine": ranking.cosine, "gate": ranking.gate}[self.rank]
        pending, total, removed = dict(counts), sum(counts.values()), set[BlockId]()
        scores: dict[BlockId, float] = {}
        for done in range(total):
            blocks = [(*stack, block) for stack, count in pending.items() if count for block in remaining[stack]]
            context.progress(f"ranking {amount(len(blocks), 'block')}", done / total)
            if not scores or self.rank == "error":
                scores = rank(blocks, removed)
            graph, name, block = least = min(blocks, key=scores.__getitem__)
            removed.add(least)
            pending[graph, name] -= 1
            yield (graph, name), block

    def _selected_stacks(self, sizes: Mapping[StackId, int], source: Bundle) -> dict[StackId, int]:
        names = [name for _, name in sizes]
        if not sizes:
            refuse_traced(source, "lists of blocks", "vlatool prune depth")
            raise RecipeError(
                f"{source.manifest.name} has no stack of blocks: an nn.ModuleList or nn.Sequential of modules of one "
                "class, each with an output like its input.",
                "prune widths instead: vlatool prune neurons",
            )
        selection = Selection.protecting(PROTECTED_WORDS, source.manifest.parts, self.include, self.exclude)
        selection.check(names, "stack of blocks")
        selected = {(graph, name): size for (graph, name), size in sizes.items() if selection.selects((name,))}
        if not selected:
            raise RecipeError(
                f"Perception and action are protected, and {source.manifest.name} has no other stack of blocks: "
                f"{_list_stacks(sizes)}.",
                "name the stacks that may lose blocks: --include NAME",
            )
        return selected


def _list_stacks(sizes: Mapping[StackId, int]) -> str:
    return ", ".join(f"{name or 'the module itself'} ({size})" for (_, name), size in sizes.items())


def _explicit_blocks(sizes: Mapping[StackId, int], keep: Sequence[int]) -> dict[StackId, list[int]]:
    """Return the same blocks for each stack."""
    if len(set(sizes.values())) > 1:
        raise RecipeError(
            f"--keep numbers the blocks of stacks of one length; these differ: {_list_stacks(sizes)}.",
            "name the stacks of one length with --include, and prune the others in another step",
        )
    size = next(iter(sizes.values()))
    if outside := [number for number in keep if not 0 <= number < size]:
        raise RecipeError(
            f"--keep names block {outside[0]}; {_list_stacks(sizes)} has the blocks 0 to {size - 1}.",
            f"name blocks from 0 to {size - 1}",
        )
    if len(keep) == size:
        raise RecipeError(f"--keep names all blocks of {_list_stacks(sizes)}.", "omit the blocks to remove")
    return {stack: sorted(keep) for stack in sizes}


def evenly_spaced(size: int, count: int) -> list[int]:
    """Return ``count`` evenly spaced indices below ``size``, including the first and (of several) the last."""
    steps = max(1, count - 1)
    return [(2 * number * (size - 1) + steps) // (2 * steps) for number in range(count)]
