"""What products do to the axes of their values: linear layers, convolutions, attention, recurrent layers, einsum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlatool.module._axis_values import Rule, Values, argument, sizes_of
from vlatool.module.factors import Axis, Shape


def _linear(walk: Values, node: Any) -> Shape:
    given, weight = walk.shape_of(node.args[0]), walk.shape_of(node.args[1])
    walk.contract(node.args[0], given[-1], node.args[1], weight[-1])
    out = weight[:-1]
    if out and argument(node, "bias") is not None:
        walk.factors.unite(out[0], walk.shape_of(argument(node, "bias"))[0])
    walk.multiply([*given, *out], weight)
    return [*given[:-1], *out]


def _matmul(walk: Values, node: Any) -> Shape:
    return _product(walk, *node.args[:2])


def _product(walk: Values, left: Any, right: Any) -> Shape:
    """Multiply matrices; a vector is a matrix with an axis of size 1, which the result lacks."""
    one, other = walk.shape_of(left), walk.shape_of(right)
    rows = one if len(one) > 1 else [(), *one]
    columns = other if len(other) > 1 else [*other, ()]
    walk.contract(left, rows[-1], right, columns[-2])
    batch = walk.broadcast([rows[:-2], columns[:-2]])
    stored = [axis for node, shape in ((left, one), (right, other)) if node in walk.stored for axis in shape]
    walk.multiply([*batch, *rows[-2:], columns[-1]], stored)
    return [*batch, *(rows[-2:-1] if len(one) > 1 else []), *(columns[-1:] if len(other) > 1 else [])]


def _add_product(walk: Values, node: Any) -> Shape:
    return walk.broadcast([_product(walk, *node.args[1:3]), walk.shape_of(node.args[0])])


def _tensordot(walk: Values, node: Any) -> Shape:
    one, other = (walk.shape_of(each) for each in node.args[:2])
    pairs = [(left % len(one), right % len(other)) for left, right in zip(*node.args[2:4], strict=True)]
    for left, right in pairs:
        walk.contract(node.args[0], one[left], node.args[1], other[right])
    rows = [axis for number, axis in enumerate(one) if number not in {left for left, _ in pairs}]
    columns = [axis for number, axis in enumerate(other) if number not in {right for _, right in pairs}]
    stored = [axis for each in node.args[:2] if each in walk.stored for axis in walk.shape_of(each)]
    walk.multiply([*rows, *(one[left] for left, _ in pairs), *columns], stored)
    return [*rows, *columns]


def _bilinear(walk: Values, node: Any) -> Shape:
    one, other, weight = (walk.shape_of(each) for each in node.args[:3])
    for number, given in ((1, one), (2, other)):
        walk.contract(node.args[number - 1], given[-1], node.args[2], weight[number])
    walk.unite_argument(node, "bias", weight[0])
    lead = walk.broadcast([one[:-1], other[:-1]])
    walk.multiply([*lead, *weight], weight)
    return [*lead, weight[0]]


def _convolution(walk: Values, node: Any) -> Shape:
    """Convolve each group of channels by itself; a depthwise convolution has one channel in each."""
    given, weight, groups, inside = _group_channels(walk, node)
    walk.contract(node.args[0], inside, node.args[1], weight[1])
    slow, _ = walk.factors.split_axis(weight[0], walk.factors.size(groups))
    walk.factors.unite(groups, slow)
    return _convolution_output(walk, node, given, weight[0], weight[2:])


def _transposed_convolution(walk: Values, node: Any) -> Shape:
    """Convolve the other way round: the weight's first axis is the input's, its second one that of a group's output."""
    given, weight, groups, inside = _group_channels(walk, node)
    walk.contract(node.args[0], (*groups, *inside), node.args[1], weight[0])
    return _convolution_output(walk, node, given, (*groups, *weight[1]), weight[2:])


def _group_channels(walk: Values, node: Any) -> tuple[Shape, Shape, Axis, Axis]:
    """Return the axes of input and weight, that of the groups, and that of the input's channels in a group."""
    given, weight = walk.shape_of(node.args[0]), walk.shape_of(node.args[1])
    number = argument(node, "groups", 1)
    groups, inside = walk.factors.split_axis(given[-len(weight) + 1], number)
    if number > 1:
        walk.counts[node] = {("groups", None): [groups]}
    return given, weight, groups, inside


def _convolution_output(walk: Values, node: Any, given: Shape, out: Axis, kernel: Shape) -> Shape:
    """Return the axes of what a convolution gives: batch, channels, places."""
    lead, spatial = given[: -len(kernel) - 1], given[-len(kernel) :]
    walk.unite_argument(node, "bias", out)
    walk.freeze((*spatial, *kernel))
    weight = walk.shape_of(node.args[1])
    space = walk.frozen_axes(sizes_of(node.meta["val"])[-len(kernel) :])
    counted = spatial if "transpose" in node.target._opname else space
    walk.multiply([*lead, *weight, *counted], weight[:2])
    return [*lead, out, *space]


def _attention(walk: Values, node: Any) -> Shape:
    query, key, value = (walk.shape_of(each) for each in node.args[:3])
    walk.contract(node.args[0], query[-1], node.args[1], key[-1])
    walk.factors.unite(key[-2], value[-2])
    walk.factors.freeze(key[-2])
    if argument(node, "scale") is None:  # the root of the size, which would change
        walk.factors.freeze(query[-1])
    if argument(node, "enable_gqa"):  # several heads of the query share one of the keys and values
        shared, _ = walk.factors.split_axis(query[-3], walk.factors.size(key[-3]))
        for other in (key, value):
            walk.factors.unite(shared, other[-3])
        walk.broadcast([query[:-3], key[:-3], value[:-3]])
        batch = query[:-2]
    else:
        batch = walk.broadcast([query[:-2], key[:-2], value[:-2]])
    if argument(node, "attn_mask") is not None:
        walk.broadcast([[*batch, query[-2], key[-2]], walk.shape_of(argument(node, "attn_mask"))])
    walk.multiply([*batch, *query[-2:], key[-2]])
    walk.multiply([*batch, query[-2], key[-2], value[-1]])
    return [*batch, query[-2], value[-1]]


def _cell(walk: Values, node: Any) -> Any:
    """One step of a recurrent layer: GRU, LSTM, RNN."""
    states = node.args[1] if isinstance(node.args[1], list | tuple) else [node.args[1]]
    given = walk.shape_of(node.args[0])
    hidden = _gates(walk, node.args[0], given[-1], node.args[2:], given[:-1])
    shapes = [walk.broadcast([[*given[:-1], hidden], walk.shape_of(state)]) for state in states]
    return shapes if len(shapes) > 1 else shapes[0]


def _recurrent(walk: Values, node: Any) -> list[Shape]:
    """Recurrent layers over a sequence: all of them and both directions have the same hidden units."""
    given, weights = walk.shape_of(node.args[0]), list(argument(node, "params"))
    states = node.args[1] if isinstance(node.args[1], list | tuple) else [node.args[1]]
    ways, layers = 1 + bool(argument(node, "bidirectional")), argument(node, "num_layers")
    each = len(weights) // (ways * layers)
    if len(given) != 3 or each != (4 if argument(node, "has_biases") else 2):
        raise ValueError("a projection, or a packed sequence")
    walk.freeze(given[:2])
    read, hidden = given[-1], walk.shape_of(weights[1])[1]
    (way,) = walk.frozen_axes([ways])
    for layer in range(layers):
        for number in range(layer * ways, (layer + 1) * ways):
            of_way = _gates(walk, None, read, weights[number * each : (number + 1) * each], given[:2])
            walk.factors.unite(hidden, of_way)
        read = (*way, *hidden)
    shapes = [walk.shape_of(state) for state in states]
    for shape in shapes:
        walk.factors.freeze(shape[0])
        walk.factors.unite(shape[-1], hidden)
    return [[*given[:2], read], *shapes]


def _gates(walk: Values, node: Any, read: Axis, weights: Sequence[Any], lead: Shape) -> Axis:
    """Unite the axes of a recurrent layer's weights; return that of its hidden units.

    Args:
        weights: for the input (gates x hidden, read), for the state (gates x hidden, hidden), biases (gates x hidden).
    """
    first, second = walk.shape_of(weights[0]), walk.shape_of(weights[1])
    walk.contract(node, read, weights[0], first[1])
    walk.reads |= set(second[1])
    gates, hidden = walk.factors.split_axis(second[0], walk.factors.size(second[0]) // walk.factors.size(second[1]))
    walk.factors.freeze(gates)
    walk.factors.unite(hidden, second[1])
    others = [walk.shape_of(each) for each in weights[2:] if each is not None]
    for shape in (first, *others):
        walk.factors.unite(shape[0], second[0])
    for weight in (first, second):
        walk.multiply([*lead, *weight], weight)
    return second[1]


def _einsum(walk: Values, node: Any) -> Shape:
    nodes = list(node.args[1])
    left, _, right = node.args[0].replace(" ", "").partition("->")
    terms = left.split(",")
    rests = [len(walk.shape_of(each)) - len(term.replace("...", "")) for each, term in zip(nodes, terms, strict=True)]
    most = max(rests, default=0)
    names = [_letters(term, rest) for term, rest in zip(terms, rests, strict=True)]
    if "->" not in node.args[0]:
        single = [name for name in sorted(set(left) - set(".,")) if left.count(name) == 1]
        right = ("..." if "..." in left else "") + "".join(single)
    result = _letters(right, most)
    axes: dict[str, Axis] = {}
    for name in dict.fromkeys(name for each in names for name in each):
        axes[name] = _named_axis(walk, name, names, nodes, result)
    _pairs(walk, names, axes, result, nodes)
    return [axes[name] for name in result]


def _letters(term: str, rest: int) -> list[str]:
    """Return names of the axes of a term; those of its ellipsis are numbered from the last one."""
    before, dots, after = term.partition("...")
    return [*before, *(str(number) for number in range(rest, 0, -1) if dots), *after]


def _named_axis(walk: Values, name: str, names: Sequence[list[str]], nodes: Sequence[Any], result: list[str]) -> Axis:
    """Unite all axes of one name; a sum over it reads weights, and one within a single value keeps its elements."""
    occurrences = [(node, number) for node, each in zip(nodes, names, strict=True)
              for number, other in enumerate(each) if other == name]  # fmt: skip
    twice = any(each.count(name) > 1 for each in names)
    (axis,) = walk.broadcast([[walk.shape_of(node)[number]] for node, number in occurrences])
    full = [(node, number) for node, number in occurrences if walk.factors.size(walk.shape_of(node)[number]) > 1]
    summed = name not in result
    if twice or (summed and (len(full) < 2 or not walk.is_silent([node for node, _ in full]))):
        walk.factors.freeze(axis)
    if summed:
        axes = (walk.shape_of(node)[number] for node, number in occurrences if node in walk.stored)
        walk.reads |= {part for axis in axes for part in axis}
    return axis


def _pairs(walk: Values, names: Sequence[list[str]], axes: dict[str, Axis], result: list[str], nodes: Any) -> None:
    """Note the products: values are multiplied one after the other, and what nothing later needs is summed up."""
    held = set(names[0])
    for number, own in enumerate(names[1:], 1):
        later = set(result).union(*names[number + 1 :])
        run = (held & set(own)) | ((held | set(own)) & later)
        pair = nodes[:2] if number == 1 else nodes[number : number + 1]
        stored = [axis for node in pair if node in walk.stored for axis in walk.shape_of(node)]
        walk.multiply([axes[name] for name in sorted(run)], stored)
        held = run & later


PRODUCTS: dict[str, Rule] = {
    "linear": _linear, **dict.fromkeys(("matmul", "mm", "bmm", "mv", "dot"), _matmul),
    **dict.fromkeys(("addmm", "baddbmm", "addmv"), _add_product), "bilinear": _bilinear, "einsum": _einsum,
    "tensordot": _tensordot,
    **{f"conv{rank}d": _convolution for rank in (1, 2, 3)},
    **{f"conv_transpose{rank}d": _transposed_convolution for rank in (1, 2, 3)},
    "scaled_dot_product_attention": _attention,
    **dict.fromkeys(("gru", "lstm", "rnn_tanh", "rnn_relu"), _recurrent),
    **dict.fromkeys(("gru_cell", "lstm_cell", "rnn_tanh_cell", "rnn_relu_cell"), _cell),
}  # fmt: skip
