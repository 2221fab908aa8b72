"""Structured pruning: remove heads, neurons and channels with all coupled weights, until the policy does less work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.module.axes import Walk
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._reduction_record import MIN_REACHED, describe_reduction, reduction_record, refuse_shortfall
from vlatool.prune._selection import Selection
from vlatool.prune._unit_groups import Macs, Rank, UnitGroup, find_groups, rank_units, trace_walks
from vlatool.stage.base import Context
from vlatool.stage.controls import PRUNED_KEY

if TYPE_CHECKING:
    from torch import nn


class Structured(ModuleStage):
    """Remove the least important heads, neurons and channels, until a share of the multiply-accumulates is gone.

    Coupled weights are found in a trace of the policy, through reshapes: heads are removed as a whole, with their rows
    of the projections. Normalised axes, inputs, outputs and embeddings stay. ``gate`` ranks by how much the action
    changes when a unit is scaled (one backward pass for each observation); ``magnitude`` by the norms of the weights
    that write and that read a unit; ``random`` is the control. Train the result afterwards (``vlatool distill policy``
    takes it unchanged).
    """

    ratio: float = Field(0.3, gt=0, lt=1, description="share of the multiply-accumulates to remove")
    rank: Rank = Field("gate", description="how units are ranked")
    samples: int = Field(32, ge=1, description="recorded observations to rank on")
    multiple: int = Field(16, ge=1, description="keep a multiple of this many neurons and channels")
    least: float = Field(0.125, gt=0, le=1, description="minimum share of each group to keep")
    include: tuple[str, ...] = Field((), description="globs of weights to prune; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of weights to leave as they are")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the units to keep.

        Raises:
            RecipeError: when everything removable is excluded, or a pattern matches nothing.
            SourceError: when torch.export cannot trace a module.
            FallsShort: when it misses the ratio by more than a tenth.
        """
        context.progress("tracing the policy", None)
        walks = trace_walks(modules, source)
        groups = find_groups(walks, Selection(self.include, self.exclude), self.multiple, source.manifest.name)
        context.progress(f"ranking the units of {len(groups)} groups", None)
        if groups:
            rank_units(groups, self.rank, modules, source, self.samples)
        changes = self.choose(walks, groups, {step.graph: step.repeat for step in source.manifest.program}, context)
        refuse_shortfall(changes.record[PRUNED_KEY])
        unrecorded = unrecorded_note(source, self.samples) if groups and self.rank == "gate" else ()
        return replace(changes, messages=(*unrecorded, *changes.messages))

    def choose(
        self, walks: Mapping[str, Walk], groups: Sequence[UnitGroup], runs: Mapping[str, int], context: Context
    ) -> ModuleChanges:
        """Remove units from ranked groups.

        Args:
            groups: Groups of units, ranked.
            runs: Graph name -> number of runs in an inference.
        """
        work = Macs(walks, runs, groups)
        self._remove(groups, work, context)
        whole, remaining = [group.size for group in groups], [group.remaining for group in groups]
        record = reduction_record(self.ratio, work, whole, remaining, walks.values())
        edits = tuple(group.edit() for group in groups if group.remaining < group.size)
        return ModuleChanges(edits, record={PRUNED_KEY: record}, messages=tuple(describe_reduction(record)))

    def _remove(self, groups: Sequence[UnitGroup], work: Macs, context: Context) -> None:
        """Remove units, in the order of importance for the work that they save, while there are any."""
        sizes = [group.size for group in groups]
        whole = left = work.macs(sizes)
        goal = whole * (1 - self.ratio)
        before, last = left, list[int]()
        while left > goal:
            context.progress("choosing what goes", min(1.0, (whole - left) / (whole - goal)))
            prices = []
            for number, group in enumerate(groups):
                cost, removed = group.cheapest_units(self.least)
                saved = work.savings(number, sizes[number] - len(removed), sizes)
                prices += [(cost / saved, number, removed)] if saved > 0 else []
            if not prices:
                return
            _, number, last = min(prices)
            groups[number].remove(last)
            sizes[number] = groups[number].remaining
            before, left = left, work.macs(sizes)
        wanted = self.ratio * whole
        if last and whole - left > (2 - MIN_REACHED) * wanted and whole - before >= MIN_REACHED * wanted:
            groups[number].restore(last)  # the last step was too large, and the result before it is close enough
