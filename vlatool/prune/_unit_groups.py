"""Groups of removable units with all weights that they are coupled to, and the importance of each unit."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.axes import Member, Walk
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.module.edits import Edit
from vlatool.module.episode_context import LEADING_OBSERVATIONS, passages
from vlatool.module.feeds import first_feeds
from vlatool.module.unit_removal import trace_module
from vlatool.prune._action_gradients import action_gradients
from vlatool.prune._selection import Selection

if TYPE_CHECKING:
    from torch import Tensor, nn

SEED = 0
Rank = Literal["gate", "magnitude", "random"]


@dataclass
class UnitGroup:
    """Units that are removed together with all their weights: heads of an attention, neurons of an MLP, channels.

    Args:
        leaf: Factor of ``vlatool.module.axes``.
        members: Axes of weights that contain the units.
        step: Number of units to remove at a time.
        keep: Indices of the units to keep.
    """

    graph: str
    leaf: int
    size: int
    members: list[Member]
    step: int
    importance: NDArray[Any]
    keep: list[int]

    @property
    def remaining(self) -> int:
        """Number of units that stay."""
        return len(self.keep)

    def remove(self, units: Sequence[int]) -> None:
        """Remove units."""
        gone = set(units)
        self.keep = [unit for unit in self.keep if unit not in gone]

    def restore(self, units: Sequence[int]) -> None:
        """Restore removed units."""
        self.keep = sorted([*self.keep, *units])

    def cheapest_units(self, min_share: float) -> tuple[float, list[int]]:
        """Return the total importance of the least important units, and their indices; none when all must stay."""
        count = self.remaining % self.step or self.step
        if self.remaining - count < max(1, round(self.size * min_share)):
            return 0.0, []
        order = sorted(self.keep, key=lambda unit: (self.importance[unit], unit))[:count]
        return float(sum(self.importance[unit] for unit in order)), order

    def edit(self, member: Member | None = None, keep: Sequence[int] | None = None) -> Edit:
        """Return the edit that keeps units.

        Args:
            member: Member whose weight and axis name the units in the edit; the first one when None.
            keep: Indices of the units to keep; those of the group when None.
        """
        member = member or self.members[0]
        return Edit(self.graph, member.weight, member.units, tuple(self.keep if keep is None else keep))


def trace_walks(modules: Mapping[str, nn.Module], source: Bundle) -> dict[str, Walk]:
    """Trace the modules of a policy; return graph name -> its axes."""
    return {graph: Walk(trace_module(modules[graph], feeds)) for graph, feeds in first_feeds(modules, source).items()}


def find_groups(walks: Mapping[str, Walk], selection: Selection, multiple: int, name: str) -> list[UnitGroup]:
    """Return all groups of removable units; none where operators keep all of them.

    Args:
        multiple: Number of neurons or channels to remove at a time; heads go one by one.
    """
    groups = []
    names: list[str] = []
    for graph, walk in walks.items():
        for leaf, members in walk.members().items():
            size = walk.factors.sizes[leaf]
            names += [member.weight for member in members]
            if not _is_slowest(walk, members) or not selection.selects(member.weight for member in members):
                continue
            heads = not all(member.atom.is_fastest for member in members)
            step = 1 if heads or size <= multiple else multiple
            groups.append(UnitGroup(graph, leaf, size, members, step, np.zeros(size), list(range(size))))
    if names:
        selection.check(names, "weight that can be pruned")
    if names and not groups:
        raise no_units(name)
    return groups


def no_units(name: str) -> RecipeError:
    """Return the error for a policy without removable units."""
    return RecipeError(
        f"{name} has no heads, neurons or channels that can be removed.",
        "look at --include and --exclude; whole blocks: vlatool prune depth",
    )


def rank_units(
    groups: Sequence[UnitGroup], rank: Rank, modules: Mapping[str, nn.Module], source: Bundle, samples: int
) -> None:
    """Set the importance of all units.

    Args:
        rank: ``gate``: the expected squared change of the action when a unit is scaled; ``magnitude``: the norms of
            the weights that write and that read it; ``random``.
    """
    if rank == "random":
        random = np.random.default_rng(SEED)
        for group in groups:
            group.importance = random.random(group.size)
        return
    weights = {graph: dict(module.named_parameters()) for graph, module in modules.items()}
    if rank == "magnitude":
        for group in groups:
            group.importance = _magnitude(group, weights[group.graph])
        return
    values = {(graph, name): value.requires_grad_() for graph, named in weights.items()
              for name, value in named.items() if value.is_floating_point()}  # fmt: skip
    try:
        for slopes in action_gradients(_actions(modules, source, samples), values):
            for group in groups:
                sensitivity = np.zeros(group.size)
                for member in [each for each in group.members if each.reads] or group.members:
                    if (key := (group.graph, member.weight)) in slopes:
                        sensitivity += _sum_by_unit(values[key].detach() * slopes[key], member)
                group.importance = group.importance + sensitivity**2
    finally:
        for value in values.values():
            value.requires_grad_(False)


class Macs:
    """Counter of the multiply-accumulates of one inference; ``runs`` maps graph names to numbers of runs."""

    def __init__(self, walks: Mapping[str, Walk], runs: Mapping[str, int], groups: Sequence[UnitGroup]) -> None:
        self._group_indices = {(group.graph, group.leaf): number for number, group in enumerate(groups)}
        self._sizes = [group.size for group in groups]
        self._terms: list[tuple[int, list[int], frozenset[str]]] = []
        self._terms_of_group: list[list[int]] = [[] for _ in groups]
        for graph, walk in walks.items():
            for product in range(len(walk.products)):
                for (leaves, keepers), macs in walk.terms(product).items():
                    self._add(graph, walk, leaves, keepers, runs[graph] * macs)

    def savings(self, number: int, size: int, sizes: Sequence[int]) -> int:
        """Return the multiply-accumulates saved by reducing one group to ``size`` units, from ``sizes`` of all."""
        less = {number: size}
        terms = (self._terms[term][:2] for term in self._terms_of_group[number])
        return sum(
            fixed
            * (math.prod(sizes[each] for each in loses) - math.prod(less.get(each, sizes[each]) for each in loses))
            for fixed, loses in terms
        )

    def saved_alone(self, number: int, size: int) -> int:
        """Return the multiply-accumulates saved by reducing one group to ``size`` units, with all others whole."""
        return self.savings(number, size, self._sizes)

    def macs(self, sizes: Sequence[int]) -> int:
        """Return the multiply-accumulates for these numbers of units."""
        return sum(self._term_macs(sizes))

    def keepers(self, sizes: Sequence[int]) -> dict[str, float]:
        """Return operator that keeps a whole width of layers -> share of the work in these layers."""
        each = self._term_macs(sizes)
        kept: Counter[str] = Counter()
        for macs, (_, _, keepers) in zip(each, self._terms, strict=True):
            kept.update(dict.fromkeys(sorted(keepers), macs))
        return {keeper: macs / max(sum(each), 1) for keeper, macs in kept.most_common()}

    def _add(self, graph: str, walk: Walk, leaves: Sequence[int], keepers: frozenset[str], macs: int) -> None:
        known = self._group_indices
        loses = [known[graph, leaf] for leaf in leaves if (graph, leaf) in known]
        fixed = macs * math.prod(walk.factors.sizes[leaf] for leaf in leaves if (graph, leaf) not in known)
        for number in set(loses):
            self._terms_of_group[number].append(len(self._terms))
        self._terms.append((fixed, loses, keepers))

    def _term_macs(self, sizes: Sequence[int]) -> list[int]:
        return [fixed * math.prod(sizes[number] for number in loses) for fixed, loses, _ in self._terms]


def _is_slowest(walk: Walk, members: Sequence[Member]) -> bool:
    """Return whether units do not lie within other units, as the elements of a head do."""
    return all(walk.factors.is_frozen(slower) for member in members for slower in member.atom.slower)


def _magnitude(group: UnitGroup, weights: Mapping[str, Any]) -> NDArray[Any]:
    """Return the product of the L2 norms of the weights that write and that read each unit."""
    product = np.ones(group.size)
    for reads in (False, True):
        squares = [
            _sum_by_unit(weights[member.weight].detach().abs() ** 2, member)
            for member in group.members
            if member.reads == reads and member.weight in weights and weights[member.weight].dim() > 1
        ]
        product = product * np.sqrt(np.sum(squares, axis=0)) if squares else product
    return product


def _sum_by_unit(values: Tensor, member: Member) -> NDArray[Any]:
    """Return the sum of a weight's values over each unit of a member: (units,)."""
    each = values.double().movedim(member.axis, 0).reshape(len(member.numbers), -1).sum(1)
    within = member.numbers >= 0
    return np.bincount(member.numbers[within], each.numpy()[within])


def _actions(modules: Mapping[str, nn.Module], source: Bundle, samples: int) -> Iterator[Any]:
    """Yield the raw action of each recorded observation, with the state from earlier ones."""
    program = BatchedProgram(source.manifest.program, modules)
    noise = draw_noise(program.noise, 1, np.random.default_rng(SEED))
    for passage in passages(source, program, noise, samples, LEADING_OBSERVATIONS):
        yield passage.run(program, noise)[source.manifest.spec.action.name]
