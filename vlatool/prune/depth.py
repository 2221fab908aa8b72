"""Depth pruning: whole blocks go, so that a policy is faster on every engine and keeps the shapes of all that stays."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, field_validator

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.blocks import stacks_of
from vlatool.module.edits import BLOCKS, Edit, refuse_traced
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._ranking import Place, Ranking, Stack
from vlatool.prune._selection import Selection, protected_parts
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile

PROTECTED = (
    "vision", "visual", "image", "vit", "encoder", "projector", "connector", "head", "decoder", "action", "expert"
)  # fmt: skip
"""Parts of module names whose blocks stay unless --include names them: what sees and what acts is less redundant than
the trunk between: with two of its action blocks left, pi0.5 succeeds in 26 %, with as few others in 91 % (DTR, arXiv
2606.27755)."""


class Depth(ModuleStage):
    """Remove the blocks that change the action least from stacks of equal blocks.

    ``error`` removes one block after the other, each time the one whose absence changes the actions on recorded
    observations least. ``gate`` takes one backward pass: how much the action moves when the block's contribution to the
    residual stream is scaled. ``cosine`` takes one forward pass: how little a block turns what passes through it.
    ``even`` runs nothing: what stays is spread evenly, the first and the last block with it. Train the result
    afterwards (``vlatool distill policy`` takes it as it is).

    Where policy.yaml names the shards of the weights, these stay where they are; ``even``, ``cosine`` and ``--keep``
    then hold one weight in memory at a time.
    """

    keeps_weights: ClassVar[bool] = True

    ratio: float = Field(0.5, gt=0, lt=1, description="share of the blocks of each stack that goes, at most")
    blocks: int | None = Field(None, ge=1, description="blocks of each stack that stay, in the place of --ratio")
    keep: tuple[int, ...] | None = Field(
        None, min_length=1, description="numbers of the blocks that stay, such as 0,2,4, in the place of a ranking"
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
        """What stays is said once."""
        super().check(source, profile)
        others = [f"--{name}" for name in ("ratio", "blocks", "rank") if name in self.options()]
        if self.keep and others:
            raise RecipeError(f"--keep says which blocks stay; {' and '.join(others)} would say so again.", "name one")
        if self.keep and len(set(self.keep)) < len(self.keep):
            raise RecipeError(f"--keep names a block twice: {','.join(map(str, self.keep))}.", "name each block once")

    def in_parts(self) -> bool:
        """A backward pass needs all weights; one after the other would be read very often for ``error``."""
        return bool(self.keep) or self.rank in ("even", "cosine")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the blocks that stay.

        Raises:
            RecipeError: when there is no stack of blocks to prune, a pattern matches none, or ``keep`` does not fit.
        """
        sizes = self._chosen(self._sizes(modules), source)
        left = _listed_blocks(sizes, self.keep) if self.keep else self._left(sizes, modules, source, context)
        context.messages.extend(
            f"kept {len(kept)} of {sizes[graph, name]} blocks of {name or 'the module itself'}: "
            f"{', '.join(map(str, kept))}"
            for (graph, name), kept in left.items()
        )
        edits = [Edit(graph, name, BLOCKS, tuple(kept)) for (graph, name), kept in left.items()]
        return ModuleChanges(tuple(sorted(edits, key=lambda edit: -len(edit.module))))  # stacks within blocks first

    def _sizes(self, modules: Mapping[str, nn.Module]) -> dict[Stack, int]:
        """Return how many blocks each stack has; one that several graphs share is the first one's."""
        mixed = bool(self.include) and (bool(self.keep) or self.rank == "even")
        return {next(iter(places.items())): len(stack) for places, stack in stacks_of(modules, mixed=mixed)}

    def _left(
        self, sizes: Mapping[Stack, int], modules: Mapping[str, nn.Module], source: Bundle, context: Context
    ) -> dict[Stack, list[int]]:
        """Return what stays of each stack that loses blocks."""
        goes = {stack: count for stack, size in sizes.items() if (count := self._goes(size)) > 0}
        if not goes:
            asked = f"--ratio {self.ratio:g}" if self.blocks is None else f"--blocks {self.blocks}"
            raise RecipeError(f"{asked} removes no block of {_listed(sizes)}.", "ask for more")
        if self.rank == "even":
            return {stack: spread(sizes[stack], sizes[stack] - count) for stack, count in goes.items()}
        context.messages.extend(unrecorded_note(source, self.samples))
        ranking = Ranking(modules, source, self.samples)
        left = {stack: list(range(sizes[stack])) for stack in goes}
        for (graph, name), block in self._going(ranking, left, goes, context):
            left[graph, name].remove(block)
        return left

    def _goes(self, size: int) -> int:
        """Return how many blocks of a stack go; one always stays."""
        return size - self.blocks if self.blocks is not None else min(size - 1, math.floor(size * self.ratio + 1e-9))

    def _going(
        self, ranking: Ranking, left: Mapping[Stack, list[int]], goes: Mapping[Stack, int], context: Context
    ) -> Iterator[tuple[Stack, int]]:
        """Yield which block goes next; the caller takes it from what is left."""
        rank = {"error": ranking.errors, "cosine": ranking.cosine, "gate": ranking.gate}[self.rank]
        open_, total, removed = dict(goes), sum(goes.values()), set[Place]()
        scores: dict[Place, float] = {}
        for done in range(total):
            places = [(*stack, block) for stack, count in open_.items() if count for block in left[stack]]
            context.progress(f"ranking {len(places)} blocks", done / total)
            if not scores or self.rank == "error":
                scores = rank(places, removed)
            graph, name, block = least = min(places, key=scores.__getitem__)
            removed.add(least)
            open_[graph, name] -= 1
            yield (graph, name), block

    def _chosen(self, sizes: Mapping[Stack, int], source: Bundle) -> dict[Stack, int]:
        names = [name for _, name in sizes]
        if not sizes:
            refuse_traced(source, "lists of blocks", "vlatool prune depth")
            raise RecipeError(
                f"{source.manifest.name} has no stack of blocks: an nn.ModuleList or nn.Sequential of modules of one "
                "class, each of which gives what it takes.",
                "prune widths instead: vlatool prune neurons",
            )
        selection = Selection(self.include, self.exclude, PROTECTED, protected_parts(source.manifest.parts, PROTECTED))
        selection.check(names, "stack of blocks")
        chosen = {(graph, name): size for (graph, name), size in sizes.items() if selection.has((name,))}
        if not chosen:
            raise RecipeError(
                f"What sees and what acts is protected, and {source.manifest.name} has no other stack of blocks: "
                f"{_listed(sizes)}.",
                "name the stacks that may lose blocks: --include NAME",
            )
        return chosen


def _listed(sizes: Mapping[Stack, int]) -> str:
    return ", ".join(f"{name or 'the module itself'} ({size})" for (_, name), size in sizes.items())


def _listed_blocks(sizes: Mapping[Stack, int], keep: Sequence[int]) -> dict[Stack, list[int]]:
    """Return that each stack keeps these blocks.

    Raises:
        RecipeError: when the stacks differ in length, a block is not there, or all stay.
    """
    if len(set(sizes.values())) > 1:
        raise RecipeError(
            f"--keep numbers the blocks of stacks of one length; these differ: {_listed(sizes)}.",
            "name the stacks of one length with --include, and prune the others in another step",
        )
    size = next(iter(sizes.values()))
    if outside := [number for number in keep if not 0 <= number < size]:
        raise RecipeError(
            f"--keep names block {outside[0]}; {_listed(sizes)} has the blocks 0 to {size - 1}.",
            f"name blocks from 0 to {size - 1}",
        )
    if len(keep) == size:
        raise RecipeError(f"--keep names all blocks of {_listed(sizes)}.", "leave out those that are to go")
    return {stack: sorted(keep) for stack in sizes}


def spread(size: int, count: int) -> list[int]:
    """Return ``count`` of ``size`` numbers, spread evenly, the first and (of several) the last with them."""
    steps = max(1, count - 1)
    return [(2 * number * (size - 1) + steps) // (2 * steps) for number in range(count)]
