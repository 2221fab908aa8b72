"""Structured pruning: remove heads, neurons and channels with all coupled weights, until the policy does less work."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import FallsShort
from vlatool.files.printable import amount
from vlatool.module.axes import Walk
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._selection import Selection
from vlatool.prune._unit_groups import Macs, Rank, UnitGroup, find_groups, rank_units, trace_walks
from vlatool.stage.base import Context
from vlatool.stage.controls import PRUNED_KEY

if TYPE_CHECKING:
    from torch import nn

MIN_REACHED = 0.9
"""Share of the requested reduction that a result must reach."""
MAX_NAMED = 6
"""Largest number of keepers in a message."""
MIN_NAMED_SHARE = 0.005
"""Least share of the work of a keeper in a message."""


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
        context.progress(f"ranking the units of {amount(len(groups), 'group')}", None)
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


def reduction_record(goal: float, work: Macs, whole: Sequence[int], kept: Sequence[int], walks: Iterable[Walk]) -> Any:
    """Return the record of a pruning.

    Args:
        goal: Share of the multiply-accumulates to remove.
        whole: Units of each group before pruning.
        kept: Units of each group that stay.

    Returns:
        ``goal`` and ``reached`` (shares), ``macs`` (before, after), ``keeps`` (operator, or inputs and outputs ->
        share of the remaining work, in layers of which it keeps a whole width) and ``without_rule``, the operators
        whose effect on axes vlatool does not know.
    """
    before, after = work.macs(whole), work.macs(kept)
    keeps = {keeper: round(share, 4) for keeper, share in work.keepers(kept).items() if share >= MIN_NAMED_SHARE}
    unknown = sorted(set().union(*(walk.unknown for walk in walks)))
    reached = 1 - after / before if before else 0.0
    return {"asked": goal, "reached": round(reached, 4), "macs": [before, after], "keeps": keeps,
            "without_rule": unknown}  # fmt: skip


def describe_reduction(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Describe the requested and reached reduction, and the operators without a rule that keep axes."""
    before, after = record["macs"]
    work = f"{before:,} -> {after:,} multiply-accumulates"
    reached = f"asked for {record['asked']:.1%} less work, reached {record['reached']:.1%} ({work})"
    keeps = record["keeps"]
    unknown = [f"{name} ({keeps.get(name, 0):.1%})" for name in record["without_rule"]]
    explanation = "no rule says what these do to heads and channels; all that touch them stay (share of the work left)"
    return (reached, *([f"{explanation}: {', '.join(unknown)}"] if unknown else []))


def refuse_shortfall(record: Mapping[str, Any]) -> None:
    """Refuse what missed the requested reduction by more than a tenth."""
    if record["reached"] >= MIN_REACHED * record["asked"]:
        return
    names = [f"{name} ({share:.1%})" for name, share in list(record["keeps"].items())[:MAX_NAMED]]
    names += [f"{len(record['keeps']) - MAX_NAMED} more"] if len(record["keeps"]) > MAX_NAMED else []
    keepers = f" Widths that stay, with the share of the work left: {', '.join(names)}." if names else ""
    unknown = f" Without a rule: {', '.join(record['without_rule'])}." if record["without_rule"] else ""
    less = f"ask for less: --ratio {int(100 * record['reached']) / 100:.2f}; " if record["reached"] >= 0.01 else ""
    more = "let less stay: --least, --multiple 1; look at --include and --exclude; " if record["reached"] else ""
    raise FallsShort(
        f"Asked for {record['asked']:.1%} less work; no more than {record['reached']:.1%} of the multiply-accumulates "
        f"can go.{keepers}{unknown}",
        f"{less}{more}whole blocks: vlatool prune depth",
    )
