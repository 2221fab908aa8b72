"""Operators of a traced module that state sizes, after some elements of its weights are gone."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vlatool.errors import require
from vlatool.module._axis_values import argument, size_of
from vlatool.module._segment_rules import SPLITS, along_of
from vlatool.module.axes import Walk

SIZE_ARGUMENTS = {
    "reshape": 1, "view": 1, "_unsafe_view": 1, "expand": 1, "broadcast_to": 1, "unflatten": 2,
    "zeros": 0, "ones": 0, "full": 0, "empty": 0, "new_zeros": 1, "new_ones": 1, "new_full": 1, "new_empty": 1,
}  # fmt: skip
"""Operator -> which of its arguments lists sizes of what it gives."""


class Resizer:
    """Writes the new sizes into operators that state some; ``keep`` maps factors to elements that stay."""

    def __init__(self, walk: Walk, keep: Mapping[int, Sequence[int]]) -> None:
        self._walk, self._keep = walk, keep

    def resize(self, node: Any) -> None:
        """Change one operator."""
        if node.op != "call_function":
            return
        name = getattr(node.target, "_opname", "")
        try:
            if name in SIZE_ARGUMENTS and self._walk.shape(node) is not None:
                self._resize_list(node, SIZE_ARGUMENTS[name])
            elif node in self._walk.counts:
                self._resize_counts(node)
            elif name in SPLITS:
                self._split(node)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise RuntimeError(
                f"the new sizes of '{name}' in the layer '{layer_of(node)}' cannot be found "
                f"({type(error).__name__}: {error}); its arguments are {node.args}"
            ) from error

    def size(self, axis: Iterable[int]) -> int:
        """Return how many elements an axis has afterwards."""
        factors = self._walk.factors
        return math.prod(
            sum(map(self.size, factors.inside(leaf))) or len(self._keep.get(leaf, range(factors.sizes[leaf])))
            for leaf in factors.leaves(axis)
        )

    def _resize_list(self, node: Any, argument_index: int) -> None:
        """Change the sizes in a list; those that are given for a batch of any size too."""
        if not isinstance(node.args[argument_index], list | tuple):  # of another kind, such as view(dtype)
            return
        shape, stated = self._walk.shape_of(node), list(node.args[argument_index])
        first = node.args[1] % (len(shape) - len(stated) + 1) if argument_index == 2 else 0
        for number, size in enumerate(stated):
            axis = shape[number + first]
            if hasattr(size, "op"):
                stated[number] = self._scale(node, size, self.size(axis))
            elif size > 0:
                stated[number] = self.size(axis)
        node.args = (*node.args[:argument_index], stated, *node.args[argument_index + 1 :])

    def _scale(self, node: Any, size: Any, wanted: int) -> Any:
        """Return a node for a size that is computed, such as that of the batch times the heads.

        What it depends on is the batch alone, in proportion: what it is in the trace says what is left of it.
        """
        given = size_of(size.meta["val"])
        if given == wanted:
            return size
        common = math.gcd(given, wanted)
        graph = node.graph
        with graph.inserting_before(node):
            more = graph.call_function(operator.mul, (size, wanted // common))
            less = graph.call_function(operator.floordiv, (more, given // common))
        for made in (more, less):
            made.meta = {**node.meta, "val": size.meta["val"]}
        return less

    def _resize_counts(self, node: Any) -> None:
        """Change numbers that an operator states, such as that of its groups, wherever they stand."""
        names = [stated.name for stated in node.target._schema.arguments]
        for (name, index), axes in self._walk.counts[node].items():
            number, whole = (sum(size(axis) for axis in axes) for size in (self.size, self._walk.factors.size))
            if number == whole:
                continue
            value: Any = number
            if index is not None:
                value = list(argument(node, name))
                value[index] = number
            if (at := names.index(name)) < len(node.args):
                node.args = (*node.args[:at], value, *node.args[at + 1 :])
            else:
                node.kwargs = {**node.kwargs, name: value}

    def _split(self, node: Any) -> None:
        """State the size of each part, where it is another one."""
        shapes = self._walk.parts(node)
        along = along_of(node, len(shapes[0]))
        sizes = [self.size(part[along]) for part in shapes]
        if sizes != [self._walk.factors.size(part[along]) for part in shapes]:
            node.target = require("torch", "build").ops.aten.split_with_sizes.default
            node.args, node.kwargs = (node.args[0], sizes, along), {}


def layer_of(node: Any) -> str:
    """Return the name of the layer that an operator is in; empty for the module itself."""
    stack = list((node.meta.get("nn_module_stack") or {}).values())
    return str(stack[-1][0]).removeprefix("L['self'].") if stack else ""
