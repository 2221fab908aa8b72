"""Which axes of which weights belong together: what can be removed from a policy without a gap.

A module that torch.export has traced is walked once. Every axis of every value is a product of factors: a projection to
queries of 6 heads with 64 elements each has an axis of 384 = 6 x 64, as soon as a reshape says so. Axes that are added,
multiplied or contracted with each other share their factors (a union-find), so that a factor's members are all weights
that lose the same elements: heads are found through reshapes, where tools that follow whole channels stop. A
factor is frozen when elements cannot go without a change of meaning: inputs and outputs, what is normalised over, what
an operator that is not known here reads.

The idea of coupled parameters is that of DepGraph (Fang et al., arXiv 2301.12900).
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any

from vlatool.module.axis_rules import RULES, Values, sizes_of
from vlatool.module.factors import Shape


@dataclass(frozen=True)
class Member:
    """One axis of a weight that a factor is a part of.

    Args:
        weight: Name in the state of the module.
        axis: Number of the axis.
        place: Number of the factor in the axis.
        sizes: Sizes of all factors of the axis.
    """

    weight: str
    axis: int
    place: int
    sizes: tuple[int, ...]


class Walk(Values):
    """Walks a graph of torch.export and finds out which axes belong together.

    Args:
        program: An ``ExportedProgram``.
    """

    def __init__(self, program: Any) -> None:
        super().__init__()
        self.weights: dict[str, Shape] = {}
        signature = program.graph_signature
        named = {**signature.inputs_to_parameters, **signature.inputs_to_buffers,
                 **signature.inputs_to_lifted_tensor_constants}  # fmt: skip
        for node in program.graph.nodes:
            if node.op == "placeholder":
                self._placeholder(node, named.get(node.name, ""))
            elif node.op == "output":
                self._freeze_all(node.args)
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
                leaves = self.factors.leaves(axis)
                sizes = tuple(self.factors.sizes[leaf] for leaf in leaves)
                for place, leaf in enumerate(leaves):
                    if not self.factors.is_frozen(leaf):
                        found.setdefault(leaf, []).append(Member(weight, number, place, sizes))
        return found

    def _placeholder(self, node: Any, weight: str) -> None:
        value = node.meta.get("val")
        if not hasattr(value, "shape"):
            return
        shape = [self.factors.new(size, frozen=not weight) for size in sizes_of(value)]
        self.shapes[node] = shape
        if weight:
            self.weights[weight] = shape

    def _visit(self, node: Any) -> None:
        if node.target is operator.getitem:
            whole = self.shapes.get(node.args[0])
            self.shapes[node] = whole[node.args[1]] if isinstance(whole, list) and whole else self._fresh(node)
            return
        rule = RULES.get(getattr(node.target, "_opname", ""))  # what computes a size has no name of an operator
        counted = len(self.products)
        try:
            given = rule(self, node) if rule is not None else None
        except (IndexError, KeyError, TypeError, ValueError):  # a form of the operator that the rule does not know
            given = None
        if given is None or not self._fits(node, given):
            self._freeze_all((node.args, node.kwargs))
            del self.products[counted:]
            given = self._fresh(node)
        self.shapes[node] = given

    def _fits(self, node: Any, given: Any) -> bool:
        """Check what a rule says against the sizes that torch.export noted."""
        value = node.meta["val"]
        values, shapes = (value, given) if isinstance(value, list | tuple) else ([value], [given])
        return len(values) == len(shapes) and all(
            [self.factors.size(axis) for axis in shape] == sizes_of(each)
            for each, shape in zip(values, shapes, strict=True)
        )

    def _fresh(self, node: Any) -> Any:
        """Return frozen axes for what a node gives."""
        value = node.meta.get("val")
        if isinstance(value, list | tuple):
            return [self._frozen(each) for each in value]
        return self._frozen(value)

    def _frozen(self, value: Any) -> Shape | None:
        return [self.factors.new(size, frozen=True) for size in sizes_of(value)] if hasattr(value, "shape") else None

    def _freeze_all(self, arguments: Any) -> None:
        if isinstance(arguments, dict):
            arguments = list(arguments.values())
        if isinstance(arguments, list | tuple):
            for argument in arguments:
                self._freeze_all(argument)
        elif hasattr(arguments, "op"):
            for axis in self.shape(arguments) or ():
                self.factors.freeze(axis)
