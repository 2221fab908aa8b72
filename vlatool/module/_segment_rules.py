"""What concatenation, splitting, slices and padding do to axes: an axis may be a concatenation of others."""

from __future__ import annotations

from typing import Any

from vlatool.module._axis_values import Rule, Values, argument, replace_axis, sizes_of
from vlatool.module.factors import Axis, Shape

FIXED_AXES = {"hstack": 1, "column_stack": 1, "vstack": 0, "dstack": 2, "hsplit": 1, "vsplit": 0, "dsplit": 2}
"""Operators that join or split along one axis, of values of rank 2 or more -> which it is."""
SPLITS = ("chunk", "split", "split_with_sizes", "tensor_split", "unsafe_chunk", "unsafe_split",
          "unsafe_split_with_sizes", "hsplit", "vsplit", "dsplit")  # fmt: skip


def along_of(node: Any, rank: int) -> int:
    """Return the axis that an operator joins or splits."""
    fixed = FIXED_AXES.get(node.target._opname)
    if fixed is None:
        return int(argument(node, "dim", 0)) % rank
    if rank <= max(fixed, 1):
        raise ValueError("too few axes")
    return fixed


def _concatenate(walk: Values, node: Any) -> Shape:
    shapes = [walk.shape_of(part) for part in node.args[0]]
    shapes = [shape for shape in shapes if len(shape) > 1 or walk.factors.size(shape[0])]  # torch skips empty vectors
    along = along_of(node, len(shapes[0]))
    result = walk.broadcast([replace_axis(shape, along, ()) for shape in shapes])
    result[along] = walk.factors.concatenate([shape[along] for shape in shapes])
    return result


def _stack(walk: Values, node: Any) -> Shape:
    result = walk.broadcast([walk.shape_of(part) for part in node.args[0]])
    along = argument(node, "dim", 0) % (len(result) + 1)
    return [*result[:along], *walk.frozen_axes([len(node.args[0])]), *result[along:]]


def _unbind(walk: Values, node: Any) -> list[Shape]:
    given, along = walk.shape_of(node.args[0]), argument(node, "dim", 0)
    walk.factors.freeze(given[along])
    rest = [axis for number, axis in enumerate(given) if number != along % len(given)]
    return [rest for _ in node.meta["val"]]


def _split(walk: Values, node: Any) -> list[Shape]:
    given = walk.shape_of(node.args[0])
    along = along_of(node, len(given))
    pieces = walk.pieces(node, given[along], [sizes_of(value)[along] for value in node.meta["val"]])
    return [replace_axis(given, along, piece) for piece in pieces]


def _glu(walk: Values, node: Any) -> Shape:
    """Multiply the first half of an axis by a sigmoid of the second one."""
    given, along = walk.shape_of(node.args[0]), argument(node, "dim", -1)
    one, other = walk.pieces(node, given[along], [walk.factors.size(given[along]) // 2] * 2)
    walk.factors.unite(one, other)
    return replace_axis(given, along, one)


def _slice(walk: Values, node: Any) -> Shape:
    return _piece(walk, node, node)[0]


def _put_slice(walk: Values, node: Any) -> Shape:
    """Replace a slice by a value."""
    part, along = _piece(walk, node, node.args[1])
    put = walk.shape_of(node.args[1])
    walk.broadcast([replace_axis(shape, along, ()) for shape in (part, put)])
    walk.factors.unite(part[along], put[along])
    return walk.shape_of(node.args[0])


def _piece(walk: Values, node: Any, like: Any) -> tuple[Shape, int]:
    """Return the axes of a slice, and the axis that it is one of."""
    given = walk.shape_of(node.args[0])
    along = argument(node, "dim", 0) % len(given)
    whole, count = walk.factors.size(given[along]), sizes_of(like.meta["val"])[along]
    if count == whole:
        return given, along
    if argument(node, "step", 1) != 1:
        return replace_axis(given, along, _every(walk, node, given[along], count)), along
    start = _number(argument(node, "start") or 0)
    start = min(start if start >= 0 else max(start + whole, 0), whole)
    before, piece, _ = walk.factors.pieces(given[along], [start, count, whole - start - count])
    end: dict[tuple[str, int | None], list[Axis]] = {("end", None): [before, piece]}
    length: dict[tuple[str, int | None], list[Axis]] = {("length", None): [piece]}
    walk.counts[node] = {("start", None): [before]} | (length if node.target._opname == "narrow" else end)
    return replace_axis(given, along, piece), along


def _every(walk: Values, node: Any, axis: Axis, count: int) -> Axis:
    """Return the axis of every second, third ... element."""
    step = argument(node, "step")
    if count * step != walk.factors.size(axis) or _number(argument(node, "start") or 0) not in range(step):
        walk.factors.freeze(axis)
        return walk.frozen_axes([count])[0]
    slow, fast = walk.factors.split_axis(axis, count)
    walk.factors.freeze(fast)
    walk.counts[node] = {("end", None): [axis]}
    return slow


def _pad(walk: Values, node: Any) -> Shape:
    """Put elements of one value before and after those that there are; copies of others keep them."""
    given, sizes, pads = list(walk.shape_of(node.args[0])), sizes_of(node.meta["val"]), node.args[1]
    alike, counts = argument(node, "mode", "constant") == "constant", dict[tuple[str, int | None], list[Axis]]()
    for number in range(len(given) - len(pads) // 2, len(given)):
        at = 2 * (len(given) - 1 - number)
        before, after = (_number(pad) for pad in pads[at : at + 2])
        if not before and not after:
            continue
        if not alike or min(before, after) < 0 or all(map(walk.factors.is_frozen, walk.factors.leaves(given[number]))):
            walk.factors.freeze(given[number])
            (given[number],) = walk.frozen_axes(sizes[number : number + 1])
            continue
        one, other = walk.factors.new(before), walk.factors.new(after)
        counts |= {("pad", at): [one], ("pad", at + 1): [other]}
        given[number] = walk.factors.concatenate([one, given[number], other])
    walk.counts[node] = counts
    return given


def _number(value: Any) -> int:
    """Return a number that an operator is given; of one that is computed, that of the trace."""
    held = value.meta["val"] if hasattr(value, "op") else value
    return held if isinstance(held, int) else int(held.node.hint)


SEGMENTS: dict[str, Rule] = {
    **dict.fromkeys(("cat", "concat", "concatenate", "hstack", "vstack", "dstack", "column_stack"), _concatenate),
    **dict.fromkeys(SPLITS, _split), "stack": _stack, "unbind": _unbind, "glu": _glu,
    **dict.fromkeys(("slice", "narrow"), _slice), "slice_scatter": _put_slice,
    **dict.fromkeys(("pad", "constant_pad_nd"), _pad),
}  # fmt: skip
