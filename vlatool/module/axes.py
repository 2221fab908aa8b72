"""Which axes of which weights belong together: what can be removed from a policy without a gap.

A module that torch.export has traced is walked once. Every axis of every value is a product of factors: a projection to
queries of 6 heads with 64 elements each has an axis of 384 = 6 x 64, as soon as a reshape says so. Axes that are added,
multiplied or contracted with each other share their factors (a union-find), so that a factor's members are all weights
that lose the same elements: heads are found through reshapes, where tools that follow whole channels stop. A factor
may be a concatenation of axes, whose elements go where each part is written and read (``vlatool.module.factors``). It
is frozen when elements cannot go without a change of meaning: inputs and outputs, what is normalised over, what
an operator that is not known here reads.

The idea of coupled parameters is that of DepGraph (Fang et al., arXiv 2301.12900).
"""

from __future__ import annotations

import contextlib
import itertools
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from vlatool.errors import require
from vlatool.module._axis_values import Values, for_each_value, sizes_of
from vlatool.module.axis_rules import TRANSPOSES, rule_for
from vlatool.module.factors import Atom, Axis, Shape

REORDERING = (*TRANSPOSES, "permute", "movedim", "detach", "to", "_to_copy", "contiguous", "clone")
"""Operators after which a weight is still one."""
INPUT, OUTPUT = "the policy's inputs", "the policy's outputs"
"""What keeps axes, beside operators."""
Term = tuple[tuple[int, ...], frozenset[str]]
"""Factors whose elements may go, and what keeps a width."""


@dataclass(frozen=True)
class Member:
    """One axis of a weight that a factor is a part of.

    Args:
        weight: name in the state of the module.
        atom: position of the factor in the axis.
        reads: whether a product sums over the axis: the weight reads the units, which others write.
        numbers: unit that each element of the axis belongs to; -1 for none.
    """

    weight: str
    axis: int
    atom: Atom
    reads: bool
    numbers: NDArray[Any] = field(compare=False, repr=False)

    @property
    def units(self) -> str:
        """Return the axis as an edit names it."""
        return f"units {self.axis}.{'.'.join(map(str, self.atom.path))}"


class Walk(Values):
    """Walks a graph of torch.export and finds out which axes belong together.

    Args:
        program: an ``ExportedProgram``.

    Attributes:
        unknown: operators without a rule, or of a form that theirs does not know; all axes that touch them stay.
    """

    def __init__(self, program: Any) -> None:
        super().__init__()
        self._walk(program)
        if stuck := self.stuck_nodes():
            super().__init__()
            self.apart = stuck
            self._walk(program)

    def _walk(self, program: Any) -> None:
        self.weights: dict[str, Shape] = {}
        self.unknown: set[str] = set()
        signature = program.graph_signature
        named = {**signature.inputs_to_parameters, **signature.inputs_to_buffers,
                 **signature.inputs_to_lifted_tensor_constants}  # fmt: skip
        tensors: dict[int, Shape] = {}
        self._live = _live(program.graph)
        for node in program.graph.nodes:
            if node.op == "placeholder":
                weight = named.get(node.name, "")
                self._placeholder(node, weight, tensors, id(program.state_dict.get(weight, node)))
            elif node.op == "output":
                self.factors.operator = OUTPUT
                self._freeze_all(node.all_input_nodes)
            elif "val" in node.meta:
                self._visit(node)

    def parts(self, node: Any) -> list[Shape]:
        """Return the axes of each of the values that a node gives."""
        return list(self.shapes[node])

    def members(self) -> dict[int, list[Member]]:
        """Return factor -> axes of weights that it is a part of, for those whose elements may go."""
        found: dict[int, list[Member]] = {}
        for weight, shape in self.weights.items():
            for number, axis in enumerate(shape):
                reads = not self.reads.isdisjoint(axis)
                for atom in self.factors.atoms(axis):
                    if not self.factors.is_frozen(atom.leaf):
                        numbers = self.factors.numbers(axis, atom.path)
                        found.setdefault(atom.leaf, []).append(Member(weight, number, atom, reads, numbers))
        return found

    def terms(self, product: int) -> dict[Term, int]:
        """Return the multiply-accumulates of a product as a sum: factors whose elements may go -> of one element each.

        With the factors stand the operators that keep a whole width of the weights that these multiply-accumulates
        take; where axes are concatenations, each segment has its own.
        """
        widths = [self.factors.leaves(axis) for axis in self.widths[product]]
        run = [self.factors.leaves(axis) for axis in self.products[product]]
        kept = {reason for leaves in widths if leaves not in run for reason in self.factors.reasons(leaves)}
        terms: dict[Term, int] = {((), frozenset(kept)): 1}
        for leaves in run:
            ways, before = self._ways(leaves, leaves in widths), terms
            terms = {}
            for (goes, keepers), macs in before.items():
                for (more, others), size in ways.items():
                    term = tuple(sorted((*goes, *more))), keepers | others
                    terms[term] = terms.get(term, 0) + macs * size
        return terms

    def _ways(self, axis: Axis, is_width: bool) -> dict[Term, int]:
        """Return the size of an axis as such a sum."""
        ways: dict[Term, int] = {}
        for segment in self._segments_of(axis):
            goes = tuple(leaf for leaf in segment if not self.factors.is_frozen(leaf))
            size = math.prod(self.factors.sizes[leaf] for leaf in segment if leaf not in goes)
            way = goes, frozenset() if goes or not is_width else frozenset(self.factors.reasons(segment))
            ways[way] = ways.get(way, 0) + size
        return ways

    def _segments_of(self, axis: Axis) -> list[Axis]:
        """Return axes that are products alone, and an axis as a concatenation of them, in any order."""
        each = [[piece for segment in self.factors.inside(leaf) for piece in self._segments_of(segment)] or [(leaf,)]
                for leaf in self.factors.leaves(axis)]  # fmt: skip
        return [tuple(itertools.chain(*choice)) for choice in itertools.product(*each)]

    def _placeholder(self, node: Any, weight: str, tensors: dict[int, Shape], tensor: int) -> None:
        """Note the axes of an input or a weight; a weight with several names has the same axes under each."""
        value = node.meta.get("val")
        if not hasattr(value, "shape"):
            return
        self.factors.operator = INPUT
        shape = tensors.get(tensor) or [self.factors.new(size, frozen=not weight) for size in sizes_of(value)]
        self.shapes[node] = tensors[tensor] = shape
        if weight:
            self.weights[weight] = shape
            self.stored.add(node)

    def _visit(self, node: Any) -> None:
        if node.target is operator.getitem:
            whole = self.shapes.get(node.args[0])
            self.shapes[node] = whole[node.args[1]] if isinstance(whole, list) and whole else self._frozen_outputs(node)
            return
        if not hasattr(node.meta["val"], "shape") and not isinstance(node.meta["val"], list | tuple):
            return  # a size
        self.factors.operator = _name_of(node)
        self.shapes[node] = self._output_axes(node)

    def _output_axes(self, node: Any) -> Any:
        """Return the axes of what an operator gives; frozen, as those of what it is given, where no rule says them."""
        rule, counted = rule_for(node.target), len(self.products)
        try:
            given = rule(self, node) if rule is not None else None
        except (ArithmeticError, IndexError, KeyError, TypeError, ValueError):  # a form that the rule does not know
            given = None
        if node not in self._live:
            del self.products[counted:], self.widths[counted:]
        if given is not None and self._fits(node, given):
            if node.target._opname in REORDERING and node.args[0] in self.stored:
                self.stored.add(node)
            return given
        self.unknown.add(self.factors.operator)
        self._freeze_all(node.all_input_nodes)
        del self.products[counted:], self.widths[counted:]
        self.counts.pop(node, None)
        if macs := macs_of(node) if node in self._live else 0:
            widths = [axis for each in node.all_input_nodes if each in self.stored for axis in self.shape_of(each)]
            self.multiply(self.frozen_axes([macs]), widths)
        return self._frozen_outputs(node)

    def _fits(self, node: Any, given: Any) -> bool:
        """Check what a rule says against the sizes that torch.export noted."""
        value = node.meta["val"]
        values, shapes = (value, given) if isinstance(value, list | tuple) else ([value], [given])
        return len(values) == len(shapes) and all(
            [self.factors.size(axis) for axis in shape] == sizes_of(each)
            for each, shape in zip(values, shapes, strict=True)
        )

    def _frozen_outputs(self, node: Any) -> Any:
        """Return frozen axes for what a node gives."""
        return for_each_value(
            node, lambda value: self.frozen_axes(sizes_of(value)) if hasattr(value, "shape") else None
        )

    def _freeze_all(self, nodes: Iterable[Any]) -> None:
        for node in nodes:
            self.freeze(self.shape(node) or ())


def _live(graph: Any) -> set[Any]:
    """Return the nodes that what a graph gives depends on, or that change a value."""
    live: set[Any] = set()
    for node in reversed(graph.nodes):
        if node.op == "output" or node.is_impure() or not live.isdisjoint(node.users):
            live.add(node)
    return live


def _name_of(node: Any) -> str:
    """Return the name of an operator without that of its overload."""
    return str(node.target).rpartition(".")[0] if hasattr(node.target, "_opname") else str(node.target)


def macs_of(node: Any) -> int:
    """Return how many multiply-accumulates torch counts in an operator that has no rule here; 0 where it cannot."""
    require("torch", "build")
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch.utils._pytree import tree_map
    from torch.utils.flop_counter import FlopCounterMode

    def example(value: Any) -> Any:
        held = value.meta.get("val") if hasattr(value, "op") else value
        return held.new_empty(sizes_of(held)) if hasattr(held, "shape") else held

    with contextlib.suppress(Exception), FlopCounterMode(display=False) as counter:  # the seam: any operator
        with FakeTensorMode(allow_non_fake_inputs=True):
            arguments = tree_map(example, (tuple(node.args), dict(node.kwargs)))
            node.target(*arguments[0], **arguments[1])
        return int(counter.get_total_flops()) // 2
    return 0
