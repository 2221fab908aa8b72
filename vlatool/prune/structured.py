"""Structured pruning: heads, neurons and channels go, wherever they are coupled, until the policy does less work."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.axes import Member, Walk
from vlatool.module.batched import BatchedProgram, drawn
from vlatool.module.cut import traced
from vlatool.module.edits import UNITS, Edit
from vlatool.module.feeds import first_feeds, recorded_inputs
from vlatool.module.stage import Changed, ModuleStage
from vlatool.prune._selection import Selection
from vlatool.prune._slopes import slopes_of
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import Tensor, nn

SEED = 0


@dataclass
class _Group:
    """Units that go together with all their weights: heads of an attention, neurons of an MLP, channels.

    Args:
        graph: Name of the graph.
        leaf: The factor of ``vlatool.module.axes``.
        size: Number of units.
        members: Axes of weights that they are a part of.
        step: How many go at a time.
        importance: Of each unit, in the order of their numbers.
        keep: Numbers of those that stay.
    """

    graph: str
    leaf: int
    size: int
    members: list[Member]
    step: int
    importance: NDArray[Any]
    keep: list[int]

    def edit(self) -> Edit:
        """Return what is to be kept, by the first of the weights."""
        first = self.members[0]
        return Edit(self.graph, first.weight, f"{UNITS}{first.axis}.{first.place}", tuple(self.keep))


class Structured(ModuleStage):
    """Remove the least important heads, neurons and channels, until a share of the multiply-accumulates is gone.

    Which weights are coupled is found in a trace of the policy, through reshapes: heads go as a whole, with their rows
    of the projections. What is normalised over, inputs, outputs and embeddings stay. ``gate`` ranks by how much the
    action moves when a unit is scaled (one backward pass an observation); ``magnitude`` by the norms of what writes and
    what reads a unit; ``random`` is the control. Train the result afterwards
    (``vlatool distill policy`` takes it as it is).
    """

    ratio: float = Field(0.3, gt=0, lt=1, description="share of the multiply-accumulates that goes")
    rank: Literal["gate", "magnitude", "random"] = Field("gate", description="how units are ranked")
    samples: int = Field(32, ge=1, description="recorded observations to rank on")
    multiple: int = Field(16, ge=1, description="neurons and channels that stay are a multiple of this")
    least: float = Field(0.125, gt=0, le=1, description="share of each group that stays in any case")
    include: tuple[str, ...] = Field((), description="globs of weights to prune; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of weights to leave as they are")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> Changed:
        """Choose the units that stay.

        Raises:
            RecipeError: when nothing can be pruned, a pattern matches nothing, or so much cannot go.
            SourceError: when torch.export cannot trace a module.
        """
        context.tell("tracing the policy", None)
        walks = {graph: Walk(traced(modules[graph], feeds)) for graph, feeds in first_feeds(modules, source).items()}
        groups = self._groups(walks, source)
        context.tell(f"ranking the units of {len(groups)} groups", None)
        self._rank(groups, modules, source)
        runs = {step.graph: step.repeat for step in source.manifest.program}
        work = _Work(walks, runs, groups)
        self._remove(groups, work, context)
        return Changed(tuple(group.edit() for group in groups if len(group.keep) < group.size))

    def _groups(self, walks: Mapping[str, Walk], source: Bundle) -> list[_Group]:
        groups = []
        names: list[str] = []
        selection = Selection(self.include, self.exclude)
        for graph, walk in walks.items():
            for leaf, members in walk.members().items():
                size = walk.factors.sizes[leaf]
                names += [member.weight for member in members]
                if not _is_slowest(walk, members) or not selection.has(member.weight for member in members):
                    continue
                heads = any(member.place < len(member.sizes) - 1 for member in members)
                step = 1 if heads or size <= self.multiple else self.multiple
                groups.append(_Group(graph, leaf, size, members, step, np.zeros(size), list(range(size))))
        selection.check(names, "weight that can be pruned")
        if not groups:
            raise RecipeError(
                f"{source.manifest.name} has no heads, neurons or channels that could go.",
                "look at --include and --exclude; whole blocks: vlatool prune depth",
            )
        return groups

    def _rank(self, groups: Sequence[_Group], modules: Mapping[str, nn.Module], source: Bundle) -> None:
        """Fill in the importance of all units."""
        if self.rank == "random":
            random = np.random.default_rng(SEED)
            for group in groups:
                group.importance = random.random(group.size)
            return
        weights = {graph: dict(module.named_parameters()) for graph, module in modules.items()}
        if self.rank == "magnitude":
            for group in groups:
                group.importance = _magnitude(group, weights[group.graph])
            return
        values = {(graph, name): value.requires_grad_() for graph, named in weights.items()
                  for name, value in named.items() if value.is_floating_point()}  # fmt: skip
        try:
            for slopes in slopes_of(_actions(modules, source, self.samples), values):
                for group in groups:
                    moved = np.zeros(group.size)
                    for member in _readers(group):
                        if (key := (group.graph, member.weight)) in slopes:
                            moved += _by_unit(values[key].detach() * slopes[key], member).numpy()
                    group.importance = group.importance + moved**2
        finally:
            for value in values.values():
                value.requires_grad_(False)

    def _remove(self, groups: Sequence[_Group], work: _Work, context: Context) -> None:
        """Take away units, those first that cost least for the work that they save."""
        sizes = [group.size for group in groups]
        whole = left = work.macs(sizes)
        goal = whole * (1 - self.ratio)
        while left > goal:
            context.tell("choosing what goes", min(1.0, (whole - left) / (whole - goal)))
            prices = []
            for number, group in enumerate(groups):
                cost, loses = _cheapest(group, self.least)
                saved = left - work.macs([*sizes[:number], sizes[number] - len(loses), *sizes[number + 1 :]])
                prices += [(cost / saved, number, loses)] if saved > 0 else []
            if not prices:
                raise RecipeError(
                    f"No more than {1 - left / whole:.1%} of the multiply-accumulates can go.",
                    f"ask for less: --ratio {1 - left / whole:.2f}; let less stay: --least; or vlatool prune depth",
                )
            _, number, loses = min(prices)
            gone = set(loses)
            groups[number].keep = [unit for unit in groups[number].keep if unit not in gone]
            sizes[number] = len(groups[number].keep)
            left = work.macs(sizes)


class _Work:
    """Counts multiply-accumulates of one inference.

    Args:
        walks: Graph name -> walk.
        runs: Graph name -> how often it runs.
        groups: Whose units may go.
    """

    def __init__(self, walks: Mapping[str, Walk], runs: Mapping[str, int], groups: Sequence[_Group]) -> None:
        numbers = {(group.graph, group.leaf): number for number, group in enumerate(groups)}
        self._terms: list[tuple[int, list[int]]] = []
        for graph, walk in walks.items():
            for product in walk.products:
                leaves = [leaf for axis in product for leaf in walk.factors.leaves(axis)]
                loses = [numbers[graph, leaf] for leaf in leaves if (graph, leaf) in numbers]
                fixed = [walk.factors.sizes[leaf] for leaf in leaves if (graph, leaf) not in numbers]
                self._terms.append((runs[graph] * math.prod(fixed), loses))

    def macs(self, sizes: Sequence[int]) -> int:
        """Return the work with so many units of each group."""
        return sum(fixed * math.prod(sizes[number] for number in loses) for fixed, loses in self._terms)


def _is_slowest(walk: Walk, members: Sequence[Member]) -> bool:
    """Leave out what lies within another unit, such as the elements of a head."""
    for member in members:
        axis = walk.weights[member.weight][member.axis]
        slower = walk.factors.leaves(axis)[: member.place]
        if any(not walk.factors.is_frozen(other) for other in slower):
            return False
    return True


def _cheapest(group: _Group, least: float) -> tuple[float, list[int]]:
    """Return what the next units that would go are worth together, and which they are; none when all must stay."""
    stays = max(1, round(group.size * least))
    count = len(group.keep) % group.step or group.step
    if len(group.keep) - count < stays:
        return 0.0, []
    order = sorted(group.keep, key=lambda unit: (group.importance[unit], unit))[:count]
    return float(sum(group.importance[unit] for unit in order)), order


def _magnitude(group: _Group, weights: Mapping[str, Any]) -> NDArray[Any]:
    """Return the product of the L2 norms of what writes and what reads each unit."""
    product = np.ones(group.size)
    for axis in (0, 1):
        squares = [
            _by_unit(weights[member.weight].detach() ** 2, member).numpy()
            for member in group.members
            if member.axis == axis and member.weight in weights and weights[member.weight].dim() > 1
        ]
        product = product * np.sqrt(np.sum(squares, axis=0)) if squares else product
    return product


def _readers(group: _Group) -> list[Member]:
    """Return the weights that read the units; those that write them where nothing reads them."""
    return [member for member in group.members if member.axis == 1] or group.members


def _by_unit(values: Tensor, member: Member) -> Tensor:
    """Return sums of a weight's values for each unit of a member: (units,)."""
    shape = values.shape
    parts = values.reshape(*shape[: member.axis], *member.sizes, *shape[member.axis + 1 :])
    unit = member.axis + member.place
    return parts.double().sum(dim=[axis for axis in range(parts.dim()) if axis != unit])


def _actions(modules: Mapping[str, nn.Module], source: Bundle, samples: int) -> Iterator[Any]:
    """Yield the raw action of each recorded observation."""
    program = BatchedProgram(source.manifest.program, modules)
    noise = drawn(program.noise, 1, np.random.default_rng(SEED))
    for inputs in recorded_inputs(source, samples):
        yield program.run(inputs, noise)[source.manifest.spec.action.name]
