"""The axes of the values of a traced graph, and the arguments of its operators."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from vlatool.module._zero_values import ZeroValues
from vlatool.module.factors import Axis, Factors, Shape

Rule = Callable[["Values", Any], Any]
"""Walk and node -> axes of what the node gives."""


class Values:
    """The axes of the values of a graph, and the products that it computes.

    Attributes:
        products: axes over which each multiply-accumulate runs.
        widths: widths of each product, axes of the weights that it takes, without those of a kernel.
        reads: factors of axes of weights over which a product sums: what reads units, where others write them.
        counts: node -> argument that states a number, and its place in a list -> axes that have so many elements.
        apart: nodes whose equal parts are not the same, as they are where nothing keeps their elements.
        shapes: node -> axes of its value, of several values, or None where it is not a tensor.
        stored: nodes whose values are weights, or weights with their axes in another order.
    """

    def __init__(self) -> None:
        self.factors = Factors()
        self.products: list[Shape] = []
        self.widths: list[Shape] = []
        self.reads: set[int] = set()
        self.counts: dict[Any, dict[tuple[str, int | None], list[Axis]]] = {}
        self.apart: frozenset[Any] = frozenset()
        self._alike: dict[Any, Axis] = {}
        self.shapes: dict[Any, Any] = {}
        self.stored: set[Any] = set()
        self._silent = ZeroValues(self.stored)

    def shape(self, node: Any) -> Shape | None:
        """Return the axes of a node's value, None where it is not a tensor."""
        found = self.shapes.get(node)
        return found if isinstance(found, list) and (not found or isinstance(found[0], tuple)) else None

    def shape_of(self, node: Any) -> Shape:
        """Return the axes of an argument."""
        shape = self.shape(node) if hasattr(node, "op") else None
        if shape is None:
            raise TypeError("no tensor")
        return shape

    def broadcast(self, shapes: Sequence[Shape]) -> Shape:
        """Unite axes as elementwise operators do, and return those of the result."""
        rank = max(map(len, shapes), default=0)
        result: Shape = []
        for number in range(rank):
            axes = [shape[number - rank + len(shape)] for shape in shapes if number - rank + len(shape) >= 0]
            full = [axis for axis in axes if self.factors.size(axis) > 1]
            for axis in full[1:]:
                self.factors.unite(full[0], axis)
            result.append(full[0] if full else ())
        return result

    def contract(self, one: Any, axis: Axis, other: Any, with_axis: Axis) -> None:
        """Unite two axes over which a product sums, and note of those of weights that they read.

        Where neither value is zero when the weights of a unit are, the sum would lose what such a unit adds.
        """
        for node, summed in ((one, axis), (other, with_axis)):
            self.reads |= set(summed) if node in self.stored else set()
        self.factors.unite(axis, with_axis)
        if not self.is_silent([one, other]):
            self.factors.freeze(axis)

    def is_silent(self, nodes: Sequence[Any]) -> bool:
        """Say whether one of some values is zero where weights are; None is a value that a weight reads."""
        return any(node is None or self._silent(node) for node in nodes)

    def multiply(self, axes: Shape, widths: Sequence[Axis] = ()) -> None:
        """Note a product; ``widths`` are those of its weights, without those of a kernel."""
        self.products.append(axes)
        self.widths.append(list(widths))

    def pieces(self, node: Any, axis: Axis, sizes: Sequence[int]) -> list[Axis]:
        """Cut an axis into pieces; of equal ones, which piece it is is a factor of its own, and all are the same."""
        first = self.factors.leaves(axis)[:1]
        alike = len(set(sizes)) == 1 and not (first and self.factors.inside(first[0])) and node not in self.apart
        if not alike or self.factors.size(first) % len(sizes):
            return self.factors.pieces(axis, sizes)
        which, piece = self.factors.split_axis(axis, len(sizes))
        self.factors.freeze(which)
        if not self._is_stuck(piece):
            self._alike[node] = piece
        return [piece for _ in sizes]

    def stuck_nodes(self) -> frozenset[Any]:
        """Return the nodes with equal pieces all of whose elements stay, though some of one piece might go."""
        return frozenset(node for node, axis in self._alike.items() if self._is_stuck(axis))

    def _is_stuck(self, axis: Axis) -> bool:
        return all(self.factors.is_frozen(leaf) for leaf in self.factors.leaves(axis))

    def freeze(self, axes: Iterable[Axis]) -> None:
        """Let all elements of some axes stay."""
        for axis in axes:
            self.factors.freeze(axis)

    def unite_argument(self, node: Any, name: str, axis: Axis) -> None:
        """Unite an axis with that of a vector, such as a bias, where an operator is given one."""
        if (vector := argument(node, name)) is not None:
            self.factors.unite(axis, self.shape_of(vector)[0])

    def frozen_axes(self, sizes: Sequence[int]) -> Shape:
        """Return new axes whose elements stay."""
        return [self.factors.new(size, frozen=True) for size in sizes]


def argument(node: Any, name: str, otherwise: Any = None) -> Any:
    """Return an argument of an operator by the name that it has in the operator's schema, wherever it stands."""
    for number, stated in enumerate(node.target._schema.arguments):
        if stated.name == name:
            default = stated.default_value if stated.has_default_value() else otherwise
            return node.args[number] if number < len(node.args) else node.kwargs.get(name, default)
    return otherwise


def for_each_value(node: Any, shape: Callable[[Any], Shape | None]) -> Any:
    """Return the axes of what an operator gives: a shape, or one for each where it gives several values."""
    value = node.meta["val"]
    return [shape(each) for each in value] if isinstance(value, list | tuple) else shape(value)


def replace_axis(shape: Shape, along: int, axis: Axis) -> Shape:
    """Return a shape with another axis in one place."""
    result = list(shape)
    result[along] = axis
    return result


def sizes_of(value: Any) -> list[int]:
    """Return the sizes of a value; a free one by the example that was traced."""
    return [size_of(size) for size in value.shape]


def size_of(size: Any) -> int:
    """Return a size, a free one by the example that was traced."""
    return size if isinstance(size, int) else int(size.node.hint)
