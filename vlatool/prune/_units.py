"""Units that can go, together with all weights that they are coupled to, and how important each is."""

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
from vlatool.prune._selection import Selection
from vlatool.prune._slopes import slopes_of

if TYPE_CHECKING:
    from torch import Tensor, nn

SEED = 0
Rank = Literal["gate", "magnitude", "random"]


@dataclass
class Group:
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

    @property
    def stays(self) -> int:
        """Number of units that are left."""
        return len(self.keep)

    def without(self, units: Sequence[int]) -> None:
        """Remove units."""
        gone = set(units)
        self.keep = [unit for unit in self.keep if unit not in gone]

    def put_back(self, units: Sequence[int]) -> None:
        """Let units stay that were removed."""
        self.keep = sorted([*self.keep, *units])

    def cheapest(self, least: float) -> tuple[float, list[int]]:
        """Return what the next units that would go are worth together, and which they are; none when all must stay.

        Args:
            least: Share of the units that stays.
        """
        count = self.stays % self.step or self.step
        if self.stays - count < max(1, round(self.size * least)):
            return 0.0, []
        order = sorted(self.keep, key=lambda unit: (self.importance[unit], unit))[:count]
        return float(sum(self.importance[unit] for unit in order)), order

    def edit(self, member: Member | None = None, keep: Sequence[int] | None = None) -> Edit:
        """Return what is to be kept.

        Args:
            member: After whose weight and axis the edit names the units; the first one when None.
            keep: Numbers of the units that stay; those of the group when None.
        """
        member = member or self.members[0]
        return Edit(self.graph, member.weight, member.units, tuple(self.keep if keep is None else keep))


def walks_of(modules: Mapping[str, nn.Module], source: Bundle) -> dict[str, Walk]:
    """Trace the modules of a policy; return graph name -> its axes.

    Raises:
        SourceError: when torch.export cannot.
    """
    return {graph: Walk(trace_module(modules[graph], feeds)) for graph, feeds in first_feeds(modules, source).items()}


def groups_of(walks: Mapping[str, Walk], selection: Selection, multiple: int, name: str) -> list[Group]:
    """Return all units that can go; none where operators keep all of them.

    Args:
        walks: Graph name -> axes.
        selection: Of weights.
        multiple: Neurons and channels go so many at a time; heads one by one.
        name: Of the policy.

    Raises:
        RecipeError: when a pattern matches no weight, or all that could go is left out.
    """
    groups = []
    names: list[str] = []
    for graph, walk in walks.items():
        for leaf, members in walk.members().items():
            size = walk.factors.sizes[leaf]
            names += [member.weight for member in members]
            if not _is_slowest(walk, members) or not selection.has(member.weight for member in members):
                continue
            heads = not all(member.atom.is_fastest for member in members)
            step = 1 if heads or size <= multiple else multiple
            groups.append(Group(graph, leaf, size, members, step, np.zeros(size), list(range(size))))
    if names:
        selection.check(names, "weight that can be pruned")
    if names and not groups:
        raise nothing(name)
    return groups


def nothing(name: str) -> RecipeError:
    """Return the error for a policy that can lose no unit."""
    return RecipeError(
        f"{name} has no heads, neurons or channels that could go.",
        "look at --include and --exclude; whole blocks: vlatool prune depth",
    )


def rank_units(
    groups: Sequence[Group], rank: Rank, modules: Mapping[str, nn.Module], source: Bundle, samples: int
) -> None:
    """Fill in the importance of all units.

    Args:
        groups: Of the modules.
        rank: ``gate``: the expected square of what the action moves by when a unit is scaled; ``magnitude``: the norms
            of what writes and what reads it; ``random``.
        modules: Graph name -> module.
        source: For recorded observations.
        samples: How many of them.

    Raises:
        SourceError: when the policy gives actions without gradients.
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
        for slopes in slopes_of(_actions(modules, source, samples), values):
            for group in groups:
                moved = np.zeros(group.size)
                for member in _readers(group):
                    if (key := (group.graph, member.weight)) in slopes:
                        moved += _by_unit(values[key].detach() * slopes[key], member)
                group.importance = group.importance + moved**2
    finally:
        for value in values.values():
            value.requires_grad_(False)


class Work:
    """Counts multiply-accumulates of one inference.

    Args:
        walks: Graph name -> walk.
        runs: Graph name -> how often it runs.
        groups: Whose units may go.
    """

    def __init__(self, walks: Mapping[str, Walk], runs: Mapping[str, int], groups: Sequence[Group]) -> None:
        self._numbers = {(group.graph, group.leaf): number for number, group in enumerate(groups)}
        self._sizes = [group.size for group in groups]
        self._terms: list[tuple[int, list[int], frozenset[str]]] = []
        self._of: list[list[int]] = [[] for _ in groups]
        for graph, walk in walks.items():
            for product in range(len(walk.products)):
                for (leaves, keepers), macs in walk.terms(product).items():
                    self._add(graph, walk, leaves, keepers, runs[graph] * macs)

    def saved(self, number: int, size: int, sizes: Sequence[int]) -> int:
        """Return what is saved when one group has so many units instead of those that it has.

        Args:
            number: Of the group.
            size: Its units afterwards.
            sizes: Units of each group.
        """
        less = {number: size}
        terms = (self._terms[term][:2] for term in self._of[number])
        return sum(
            fixed
            * (math.prod(sizes[each] for each in loses) - math.prod(less.get(each, sizes[each]) for each in loses))
            for fixed, loses in terms
        )

    def without(self, number: int, size: int) -> int:
        """Return what is saved when one group has so many units, and all others are whole."""
        return self.saved(number, size, self._sizes)

    def macs(self, sizes: Sequence[int]) -> int:
        """Return the work with so many units of each group."""
        return sum(self._each(sizes))

    def keepers(self, sizes: Sequence[int]) -> dict[str, float]:
        """Return who keeps a whole width of layers -> share of the work in these layers, with so many units."""
        each = self._each(sizes)
        kept: Counter[str] = Counter()
        for macs, (_, _, keepers) in zip(each, self._terms, strict=True):
            kept.update(dict.fromkeys(sorted(keepers), macs))
        return {keeper: macs / max(sum(each), 1) for keeper, macs in kept.most_common()}

    def _add(self, graph: str, walk: Walk, leaves: Sequence[int], keepers: frozenset[str], macs: int) -> None:
        loses = [self._numbers[graph, leaf] for leaf in leaves if (graph, leaf) in self._numbers]
        fixed = macs * math.prod(walk.factors.sizes[leaf] for leaf in leaves if (graph, leaf) not in self._numbers)
        for number in set(loses):
            self._of[number].append(len(self._terms))
        self._terms.append((fixed, loses, keepers))

    def _each(self, sizes: Sequence[int]) -> list[int]:
        return [fixed * math.prod(sizes[number] for number in loses) for fixed, loses, _ in self._terms]


def _is_slowest(walk: Walk, members: Sequence[Member]) -> bool:
    """Leave out what lies within another unit, such as the elements of a head."""
    return all(walk.factors.is_frozen(slower) for member in members for slower in member.atom.slower)


def _magnitude(group: Group, weights: Mapping[str, Any]) -> NDArray[Any]:
    """Return the product of the L2 norms of what writes and what reads each unit."""
    product = np.ones(group.size)
    for reads in (False, True):
        squares = [
            _by_unit(weights[member.weight].detach().abs() ** 2, member)
            for member in group.members
            if member.reads == reads and member.weight in weights and weights[member.weight].dim() > 1
        ]
        product = product * np.sqrt(np.sum(squares, axis=0)) if squares else product
    return product


def _readers(group: Group) -> list[Member]:
    """Return the weights that read the units; those that write them where nothing reads them."""
    return [member for member in group.members if member.reads] or group.members


def _by_unit(values: Tensor, member: Member) -> NDArray[Any]:
    """Return sums of a weight's values for each unit of a member: (units,)."""
    each = values.double().movedim(member.axis, 0).reshape(len(member.numbers), -1).sum(1)
    within = member.numbers >= 0
    return np.bincount(member.numbers[within], each.numpy()[within])


def _actions(modules: Mapping[str, nn.Module], source: Bundle, samples: int) -> Iterator[Any]:
    """Yield the raw action of each recorded observation, with what the policy keeps of those before it."""
    program = BatchedProgram(source.manifest.program, modules)
    noise = draw_noise(program.noise, 1, np.random.default_rng(SEED))
    for passage in passages(source, program, noise, samples, LEADING_OBSERVATIONS):
        yield passage.run(program, noise)[source.manifest.spec.action.name]
