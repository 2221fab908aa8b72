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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vlatool.module.factors import Factors, Shape


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


class Walk:
    """Walks a graph of torch.export and finds out which axes belong together.

    Args:
        program: An ``ExportedProgram``.
    """

    def __init__(self, program: Any) -> None:
        self.factors = Factors()
        self.weights: dict[str, Shape] = {}
        self.products: list[Shape] = []
        self._shapes: dict[Any, Any] = {}
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

    def shape(self, node: Any) -> Shape | None:
        """Return the axes of a node's value, None where it is no tensor."""
        found = self._shapes.get(node)
        return found if isinstance(found, list) and (not found or isinstance(found[0], tuple)) else None

    def parts(self, node: Any) -> list[Shape]:
        """Return the axes of each of the values that a node gives."""
        return list(self._shapes[node])

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
        shape = [self.factors.new(size, frozen=not weight) for size in _sizes(value)]
        self._shapes[node] = shape
        if weight:
            self.weights[weight] = shape

    def _visit(self, node: Any) -> None:
        if node.target is operator.getitem:
            whole = self._shapes.get(node.args[0])
            self._shapes[node] = whole[node.args[1]] if isinstance(whole, list) and whole else self._fresh(node)
            return
        name = getattr(node.target, "_opname", None) or str(node.target).split(".")[-2]
        rule = RULES.get(name)
        counted = len(self.products)
        try:
            given = rule(self, node) if rule is not None else None
        except (IndexError, KeyError, TypeError, ValueError):  # a form of the operator that the rule does not know
            given = None
        if given is None or not self._fits(node, given):
            self._freeze_all((node.args, node.kwargs))
            del self.products[counted:]
            given = self._fresh(node)
        self._shapes[node] = given

    def _fits(self, node: Any, given: Any) -> bool:
        """Check what a rule says against the sizes that torch.export noted."""
        value = node.meta["val"]
        values, shapes = (value, given) if isinstance(value, list | tuple) else ([value], [given])
        return len(values) == len(shapes) and all(
            [self.factors.size(axis) for axis in shape] == _sizes(each)
            for each, shape in zip(values, shapes, strict=True)
        )

    def _fresh(self, node: Any) -> Any:
        """Return frozen axes for what a node gives."""
        value = node.meta.get("val")
        if isinstance(value, list | tuple):
            return [self._frozen(each) for each in value]
        return self._frozen(value)

    def _frozen(self, value: Any) -> Shape | None:
        return [self.factors.new(size, frozen=True) for size in _sizes(value)] if hasattr(value, "shape") else None

    def _freeze_all(self, arguments: Any) -> None:
        if isinstance(arguments, dict):
            arguments = list(arguments.values())
        if isinstance(arguments, list | tuple):
            for argument in arguments:
                self._freeze_all(argument)
        elif hasattr(arguments, "op"):
            for axis in self.shape(arguments) or ():
                self.factors.freeze(axis)

    def needed(self, node: Any) -> Shape:
        """Return the axes of an argument.

        Raises:
            TypeError: when it is no tensor.
        """
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


def _sizes(value: Any) -> list[int]:
    """Return the sizes of a value; a free one by the example that was traced."""
    return [size if isinstance(size, int) else int(size.node.hint) for size in value.shape]


def _same(walk: Walk, node: Any) -> Shape:
    return walk.needed(node.args[0])


def _elementwise(walk: Walk, node: Any) -> Shape:
    shapes = [walk.shape(each) for each in (*node.args, *node.kwargs.values()) if hasattr(each, "op")]
    return walk.broadcast([shape for shape in shapes if shape is not None])


def _linear(walk: Walk, node: Any) -> Shape:
    given, weight = walk.needed(node.args[0]), walk.needed(node.args[1])
    walk.factors.unite(given[-1], weight[1])
    if len(node.args) > 2 and node.args[2] is not None:
        walk.factors.unite(weight[0], walk.needed(node.args[2])[0])
    walk.products.append([*given, weight[0]])
    return [*given[:-1], weight[0]]


def _matmul(walk: Walk, node: Any) -> Shape:
    one, other = walk.needed(node.args[0]), walk.needed(node.args[1])
    if len(one) < 2 or len(other) < 2:
        raise ValueError("vectors")
    walk.factors.unite(one[-1], other[-2])
    batch = walk.broadcast([one[:-2], other[:-2]])
    walk.products.append([*batch, *one[-2:], other[-1]])
    return [*batch, one[-2], other[-1]]


def _addmm(walk: Walk, node: Any) -> Shape:
    bias, one, other = (walk.needed(argument) for argument in node.args[:3])
    walk.factors.unite(one[-1], other[-2])
    walk.products.append([*one, other[1]])
    return walk.broadcast([[one[0], other[1]], bias])


def _convolution(walk: Walk, node: Any) -> Shape:
    given, weight = walk.needed(node.args[0]), walk.needed(node.args[1])
    groups = node.args[6] if len(node.args) > 6 else node.kwargs.get("groups", 1)
    if groups == 1:
        walk.factors.unite(given[1], weight[1])
    elif groups == walk.factors.size(given[1]) == walk.factors.size(weight[0]):
        walk.factors.unite(given[1], weight[0])
    else:
        raise ValueError("grouped")
    if len(node.args) > 2 and node.args[2] is not None:
        walk.factors.unite(weight[0], walk.needed(node.args[2])[0])
    for axis in (*given[2:], *weight[2:]):
        walk.factors.freeze(axis)
    space = [walk.factors.new(size, frozen=True) for size in _sizes(node.meta["val"])[2:]]
    walk.products.append([given[0], *weight, *space])
    return [given[0], weight[0], *space]


def _channels(walk: Walk, node: Any) -> Shape:
    """Normalise every channel by itself."""
    given = walk.needed(node.args[0])
    for argument in node.args[1:5]:
        if hasattr(argument, "op"):
            walk.factors.unite(given[1], walk.needed(argument)[0])
    return given


def _over_last(walk: Walk, node: Any) -> Shape:
    """Normalise over the last axes: all of their elements count."""
    given = walk.needed(node.args[0])
    for axis, argument in [(given[-1], each) for each in node.args[2:4] if hasattr(each, "op")]:
        walk.factors.unite(axis, walk.needed(argument)[-1])
    for axis in given[-len(node.args[1]) :]:
        walk.factors.freeze(axis)
    return given


def _softmax(walk: Walk, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    walk.factors.freeze(given[node.args[1]])
    return given


def _reduce(walk: Walk, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    which = node.args[1] if len(node.args) > 1 else node.kwargs.get("dim")
    axes = range(len(given)) if which is None else ([which] if isinstance(which, int) else which)
    gone = {axis % len(given) for axis in axes}
    keep = node.args[2] if len(node.args) > 2 else node.kwargs.get("keepdim", False)
    for axis in gone:
        walk.factors.freeze(given[axis])
    return [() if number in gone else axis for number, axis in enumerate(given) if keep or number not in gone]


def _reshape(walk: Walk, node: Any) -> Shape | None:
    given = walk.needed(node.args[0])
    leaves = list(walk.factors.leaves(factor for axis in given for factor in axis))
    result: Shape = []
    for size in _sizes(node.meta["val"]):
        axis = walk.factors.taken(leaves, size)
        if axis is None:
            return None
        result.append(axis)
    return result


def _permute(walk: Walk, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    return [given[axis] for axis in node.args[1]]


def _transpose(walk: Walk, node: Any) -> Shape:
    given = list(walk.needed(node.args[0]))
    one, other = node.args[1:3] if len(node.args) > 2 else (-1, -2)
    if len(given) > 1:
        given[one], given[other] = given[other], given[one]
    return given


def _expand(walk: Walk, node: Any) -> Shape:
    given, sizes = walk.needed(node.args[0]), _sizes(node.meta["val"])
    padded = [()] * (len(sizes) - len(given)) + given
    return [axis if walk.factors.size(axis) == size else walk.factors.new(size, frozen=True)
            for axis, size in zip(padded, sizes, strict=True)]  # fmt: skip


def _concatenate(walk: Walk, node: Any) -> Shape:
    shapes = [walk.needed(part) for part in node.args[0]]
    along = (node.args[1] if len(node.args) > 1 else node.kwargs.get("dim", 0)) % len(shapes[0])
    result: Shape = []
    for number, size in enumerate(_sizes(node.meta["val"])):
        if number == along:
            for shape in shapes:
                walk.factors.freeze(shape[number])
            result.append(walk.factors.new(size, frozen=True))
            continue
        for shape in shapes[1:]:
            walk.factors.unite(shapes[0][number], shape[number])
        result.append(shapes[0][number])
    return result


def _parts(walk: Walk, node: Any) -> list[Shape] | None:
    """Cut an axis into equal parts: which part it is is a factor of its own."""
    given = walk.needed(node.args[0])
    along = (node.args[2] if len(node.args) > 2 else node.kwargs.get("dim", 0)) % len(given)
    values = [_sizes(value)[along] for value in node.meta["val"]]
    if len(set(values)) > 1:
        return None
    leaves = list(walk.factors.leaves(given[along]))
    which = walk.factors.taken(leaves, len(values))
    if which is None:
        return None
    walk.factors.freeze(which)
    part: Shape = [*given[:along], tuple(leaves), *given[along + 1 :]]
    return [part for _ in values]


def _slice(walk: Walk, node: Any) -> Shape:
    given, sizes = walk.needed(node.args[0]), _sizes(node.meta["val"])
    result = list(given)
    for number, (axis, size) in enumerate(zip(given, sizes, strict=True)):
        if walk.factors.size(axis) != size:
            walk.factors.freeze(axis)
            result[number] = walk.factors.new(size, frozen=True)
    return result


def _select(walk: Walk, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    along = node.args[1] % len(given)
    walk.factors.freeze(given[along])
    return [axis for number, axis in enumerate(given) if number != along]


def _embedding(walk: Walk, node: Any) -> Shape:
    weight, ids = walk.needed(node.args[0]), walk.needed(node.args[1])
    for axis in weight:
        walk.factors.freeze(axis)
    return [*ids, weight[1]]


def _attention(walk: Walk, node: Any) -> Shape:
    query, key, value = (walk.needed(argument) for argument in node.args[:3])
    walk.factors.unite(query[-1], key[-1])
    walk.factors.unite(key[-2], value[-2])
    walk.factors.freeze(key[-2])
    if node.kwargs.get("scale") is None:  # the root of the size, which would change
        walk.factors.freeze(query[-1])
    if len(node.args) > 3 and hasattr(node.args[3], "op"):
        walk.broadcast([[*query[:-1], key[-2]], walk.needed(node.args[3])])
    batch = walk.broadcast([query[:-2], key[:-2], value[:-2]])
    walk.products += [[*batch, *query[-2:], key[-2]], [*batch, query[-2], key[-2], value[-1]]]
    return [*batch, query[-2], value[-1]]


Rule = Callable[[Walk, Any], Any]
SAME = [
    "abs",
    "alias",
    "celu",
    "clamp",
    "clone",
    "contiguous",
    "cos",
    "detach",
    "dropout",
    "elu",
    "exp",
    "gelu",
    "hardsigmoid",
    "hardswish",
    "hardtanh",
    "leaky_relu",
    "log",
    "mish",
    "neg",
    "reciprocal",
    "relu",
    "relu_",
    "relu6",
    "rsqrt",
    "selu",
    "sigmoid",
    "silu",
    "silu_",
    "sin",
    "softplus",
    "sqrt",
    "tanh",
    "to",
    "_to_copy",
    "type_as",
    "lift_fresh_copy",
    "round",
    "floor",
    "erf",
    "bitwise_not",
    "logical_not",
]
ELEMENTWISE = [
    "add",
    "add_",
    "sub",
    "sub_",
    "mul",
    "mul_",
    "div",
    "div_",
    "pow",
    "maximum",
    "minimum",
    "where",
    "eq",
    "ne",
    "lt",
    "le",
    "gt",
    "ge",
    "logical_and",
    "logical_or",
    "rsub",
]
RULES: dict[str, Rule] = {
    **dict.fromkeys(SAME, _same), **dict.fromkeys(ELEMENTWISE, _elementwise),
    "linear": _linear, "matmul": _matmul, "mm": _matmul, "bmm": _matmul, "addmm": _addmm,
    **dict.fromkeys(("conv1d", "conv2d", "conv3d"), _convolution),
    "batch_norm": _channels, "layer_norm": _over_last, "rms_norm": _over_last,
    **dict.fromkeys(("softmax", "_softmax", "log_softmax"), _softmax),
    **dict.fromkeys(("mean", "sum", "amax"), _reduce),
    **dict.fromkeys(("reshape", "view", "_unsafe_view", "flatten", "unflatten", "unsqueeze", "squeeze"), _reshape),
    "permute": _permute, "transpose": _transpose, "t": _transpose, "expand": _expand, "cat": _concatenate,
    "chunk": _parts, "split": _parts, "split_with_sizes": _parts, "slice": _slice, "select": _select,
    "embedding": _embedding, "scaled_dot_product_attention": _attention,
}  # fmt: skip
