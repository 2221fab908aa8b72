"""What each operator does to the axes of its values: which belong together, and which must stay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from vlatool.module.factors import Factors, Shape


class Values:
    """The axes of the values of a graph, and the products that it computes.

    Attributes:
        factors: What axes are made of.
        products: Axes over which each multiply-accumulate runs.
        shapes: Node -> axes of its value, of several values, or None where it is no tensor.
    """

    def __init__(self) -> None:
        self.factors = Factors()
        self.products: list[Shape] = []
        self.shapes: dict[Any, Any] = {}

    def shape(self, node: Any) -> Shape | None:
        """Return the axes of a node's value, None where it is no tensor."""
        found = self.shapes.get(node)
        return found if isinstance(found, list) and (not found or isinstance(found[0], tuple)) else None

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


def sizes_of(value: Any) -> list[int]:
    """Return the sizes of a value; a free one by the example that was traced."""
    return [size_of(size) for size in value.shape]


def size_of(size: Any) -> int:
    """Return a size, a free one by the example that was traced."""
    return size if isinstance(size, int) else int(size.node.hint)


def _same(walk: Values, node: Any) -> Shape:
    return walk.needed(node.args[0])


def _elementwise(walk: Values, node: Any) -> Shape:
    shapes = [walk.shape(each) for each in (*node.args, *node.kwargs.values()) if hasattr(each, "op")]
    return walk.broadcast([shape for shape in shapes if shape is not None])


def _linear(walk: Values, node: Any) -> Shape:
    given, weight = walk.needed(node.args[0]), walk.needed(node.args[1])
    walk.factors.unite(given[-1], weight[1])
    if len(node.args) > 2 and node.args[2] is not None:
        walk.factors.unite(weight[0], walk.needed(node.args[2])[0])
    walk.products.append([*given, weight[0]])
    return [*given[:-1], weight[0]]


def _matmul(walk: Values, node: Any) -> Shape:
    one, other = walk.needed(node.args[0]), walk.needed(node.args[1])
    if len(one) < 2 or len(other) < 2:
        raise ValueError("vectors")
    walk.factors.unite(one[-1], other[-2])
    batch = walk.broadcast([one[:-2], other[:-2]])
    walk.products.append([*batch, *one[-2:], other[-1]])
    return [*batch, one[-2], other[-1]]


def _addmm(walk: Values, node: Any) -> Shape:
    bias, one, other = (walk.needed(argument) for argument in node.args[:3])
    walk.factors.unite(one[-1], other[-2])
    walk.products.append([*one, other[1]])
    return walk.broadcast([[one[0], other[1]], bias])


def _convolution(walk: Values, node: Any) -> Shape:
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
    space = [walk.factors.new(size, frozen=True) for size in sizes_of(node.meta["val"])[2:]]
    walk.products.append([given[0], *weight, *space])
    return [given[0], weight[0], *space]


def _channels(walk: Values, node: Any) -> Shape:
    """Normalise every channel by itself."""
    given = walk.needed(node.args[0])
    for argument in node.args[1:5]:
        if hasattr(argument, "op"):
            walk.factors.unite(given[1], walk.needed(argument)[0])
    return given


def _over_last(walk: Values, node: Any) -> Shape:
    """Normalise over the last axes: all of their elements count."""
    given = walk.needed(node.args[0])
    for axis, argument in [(given[-1], each) for each in node.args[2:4] if hasattr(each, "op")]:
        walk.factors.unite(axis, walk.needed(argument)[-1])
    for axis in given[-len(node.args[1]) :]:
        walk.factors.freeze(axis)
    return given


def _softmax(walk: Values, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    walk.factors.freeze(given[node.args[1]])
    return given


def _reduce(walk: Values, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    which = node.args[1] if len(node.args) > 1 else node.kwargs.get("dim")
    axes = range(len(given)) if which is None else ([which] if isinstance(which, int) else which)
    gone = {axis % len(given) for axis in axes}
    keep = node.args[2] if len(node.args) > 2 else node.kwargs.get("keepdim", False)
    for axis in gone:
        walk.factors.freeze(given[axis])
    return [() if number in gone else axis for number, axis in enumerate(given) if keep or number not in gone]


def _reshape(walk: Values, node: Any) -> Shape | None:
    given = walk.needed(node.args[0])
    leaves = list(walk.factors.leaves(factor for axis in given for factor in axis))
    result: Shape = []
    for size in sizes_of(node.meta["val"]):
        axis = walk.factors.taken(leaves, size)
        if axis is None:
            return None
        result.append(axis)
    return result


def _permute(walk: Values, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    return [given[axis] for axis in node.args[1]]


def _transpose(walk: Values, node: Any) -> Shape:
    given = list(walk.needed(node.args[0]))
    one, other = node.args[1:3] if len(node.args) > 2 else (-1, -2)
    if len(given) > 1:
        given[one], given[other] = given[other], given[one]
    return given


def _expand(walk: Values, node: Any) -> Shape:
    given, sizes = walk.needed(node.args[0]), sizes_of(node.meta["val"])
    padded = [()] * (len(sizes) - len(given)) + given
    return [axis if walk.factors.size(axis) == size else walk.factors.new(size, frozen=True)
            for axis, size in zip(padded, sizes, strict=True)]  # fmt: skip


def _concatenate(walk: Values, node: Any) -> Shape:
    shapes = [walk.needed(part) for part in node.args[0]]
    along = (node.args[1] if len(node.args) > 1 else node.kwargs.get("dim", 0)) % len(shapes[0])
    result: Shape = []
    for number, size in enumerate(sizes_of(node.meta["val"])):
        if number == along:
            for shape in shapes:
                walk.factors.freeze(shape[number])
            result.append(walk.factors.new(size, frozen=True))
            continue
        for shape in shapes[1:]:
            walk.factors.unite(shapes[0][number], shape[number])
        result.append(shapes[0][number])
    return result


def _parts(walk: Values, node: Any) -> list[Shape] | None:
    """Cut an axis into equal parts: which part it is is a factor of its own."""
    given = walk.needed(node.args[0])
    along = (node.args[2] if len(node.args) > 2 else node.kwargs.get("dim", 0)) % len(given)
    values = [sizes_of(value)[along] for value in node.meta["val"]]
    if len(set(values)) > 1:
        return None
    leaves = list(walk.factors.leaves(given[along]))
    which = walk.factors.taken(leaves, len(values))
    if which is None:
        return None
    walk.factors.freeze(which)
    part: Shape = [*given[:along], tuple(leaves), *given[along + 1 :]]
    return [part for _ in values]


def _slice(walk: Values, node: Any) -> Shape:
    given, sizes = walk.needed(node.args[0]), sizes_of(node.meta["val"])
    result = list(given)
    for number, (axis, size) in enumerate(zip(given, sizes, strict=True)):
        if walk.factors.size(axis) != size:
            walk.factors.freeze(axis)
            result[number] = walk.factors.new(size, frozen=True)
    return result


def _select(walk: Values, node: Any) -> Shape:
    given = walk.needed(node.args[0])
    along = node.args[1] % len(given)
    walk.factors.freeze(given[along])
    return [axis for number, axis in enumerate(given) if number != along]


def _embedding(walk: Values, node: Any) -> Shape:
    weight, ids = walk.needed(node.args[0]), walk.needed(node.args[1])
    for axis in weight:
        walk.factors.freeze(axis)
    return [*ids, weight[1]]


def _attention(walk: Values, node: Any) -> Shape:
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


Rule = Callable[[Values, Any], Any]
SAME = (
    "abs", "alias", "celu", "clamp", "clone", "contiguous", "cos", "detach", "dropout", "elu", "exp", "gelu",
    "hardsigmoid", "hardswish", "hardtanh", "leaky_relu", "log", "mish", "neg", "reciprocal", "relu", "relu_",
    "relu6", "rsqrt", "selu", "sigmoid", "silu", "silu_", "sin", "softplus", "sqrt", "tanh", "to", "_to_copy",
    "type_as", "lift_fresh_copy", "round", "floor", "erf", "bitwise_not", "logical_not",
)  # fmt: skip
ELEMENTWISE = (
    "add", "add_", "sub", "sub_", "mul", "mul_", "div", "div_", "pow", "maximum", "minimum", "where", "eq", "ne",
    "lt", "le", "gt", "ge", "logical_and", "logical_or", "rsub",
)  # fmt: skip
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
