"""Structured pruning: heads, neurons and channels go, wherever they are coupled, until the policy does less work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.module.axes import Walk
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._reached import SHORT, recorded, refuse_short, sentences
from vlatool.prune._selection import Selection
from vlatool.prune._units import Group, Rank, Work, groups_of, rank_units, walks_of
from vlatool.stage.base import Context
from vlatool.stage.controls import PRUNED_KEY

if TYPE_CHECKING:
    from torch import nn


class Structured(ModuleStage):
    """Remove the least important heads, neurons and channels, until a share of the multiply-accumulates is gone.

    Which weights are coupled is found in a trace of the policy, through reshapes: heads go as a whole, with their rows
    of the projections. What is normalised over, inputs, outputs and embeddings stay. ``gate`` ranks by how much the
    action moves when a unit is scaled (one backward pass an observation); ``magnitude`` by the norms of what writes and
    what reads a unit; ``random`` is the control. Train the result afterwards
    (``vlatool distill policy`` takes it as it is).
    """

    ratio: float = Field(0.3, gt=0, lt=1, description="share of the multiply-accumulates that goes")
    rank: Rank = Field("gate", description="how units are ranked")
    samples: int = Field(32, ge=1, description="recorded observations to rank on")
    multiple: int = Field(16, ge=1, description="neurons and channels that stay are a multiple of this")
    least: float = Field(0.125, gt=0, le=1, description="share of each group that stays in any case")
    include: tuple[str, ...] = Field((), description="globs of weights to prune; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of weights to leave as they are")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the units that stay.

        Raises:
            RecipeError: when all that could go is left out, or a pattern matches nothing.
            SourceError: when torch.export cannot trace a module.
        """
        context.progress("tracing the policy", None)
        walks = walks_of(modules, source)
        groups = groups_of(walks, Selection(self.include, self.exclude), self.multiple, source.manifest.name)
        context.progress(f"ranking the units of {len(groups)} groups", None)
        if groups:
            context.messages.extend(unrecorded_note(source, self.samples) if self.rank == "gate" else ())
            rank_units(groups, self.rank, modules, source, self.samples)
        return self.choose(walks, groups, {step.graph: step.repeat for step in source.manifest.program}, context)

    def choose(
        self, walks: Mapping[str, Walk], groups: Sequence[Group], runs: Mapping[str, int], context: Context
    ) -> ModuleChanges:
        """Take units from ranked groups.

        Args:
            walks: Graph name -> its axes.
            groups: Of units, ranked.
            runs: Graph name -> how often it runs in an inference.
            context: For progress.
        """
        work = Work(walks, runs, groups)
        self._remove(groups, work, context)
        whole, left = [group.size for group in groups], [group.stays for group in groups]
        record = recorded(self.ratio, work, whole, left, walks.values())
        context.messages.extend(sentences(record))
        edits = tuple(group.edit() for group in groups if group.stays < group.size)
        return ModuleChanges(edits, record={PRUNED_KEY: record})

    def accept(self, bundle: Bundle) -> None:
        """Refuse what falls short of the ratio.

        Raises:
            FallsShort: by more than a tenth.
        """
        refuse_short(bundle)

    def _remove(self, groups: Sequence[Group], work: Work, context: Context) -> None:
        """Take away units, those first that cost least for the work that they save, as long as there are any."""
        sizes = [group.size for group in groups]
        whole = left = work.macs(sizes)
        goal = whole * (1 - self.ratio)
        before, last = left, list[int]()
        while left > goal:
            context.progress("choosing what goes", min(1.0, (whole - left) / (whole - goal)))
            prices = []
            for number, group in enumerate(groups):
                cost, loses = group.cheapest(self.least)
                saved = work.saved(number, sizes[number] - len(loses), sizes)
                prices += [(cost / saved, number, loses)] if saved > 0 else []
            if not prices:
                return
            _, number, last = min(prices)
            groups[number].without(last)
            sizes[number] = groups[number].stays
            before, left = left, work.macs(sizes)
        if last and whole - left > (2 - SHORT) * self.ratio * whole and whole - before >= SHORT * self.ratio * whole:
            groups[number].put_back(last)  # one step was too much, and nearly enough was gone before it
