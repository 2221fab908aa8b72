"""What each operator does to the axes of its values: which belong together, and which must stay."""

from __future__ import annotations

from typing import Any

from vlatool.module._axis_values import Rule, argument, for_each_value, replace_axis, sizes_of
from vlatool.module._axis_values import Values as Values
from vlatool.module._axis_values import size_of as size_of
from vlatool.module._layer_rules import LAYERS
from vlatool.module._product_rules import PRODUCTS
from vlatool.module._segment_rules import SEGMENTS
from vlatool.module.factors import Shape


def _same(walk: Values, node: Any) -> Shape:
    return walk.shape_of(node.args[0])


def _elementwise(walk: Values, node: Any) -> Shape:
    shapes = [walk.shape(each) for each in (*node.args, *node.kwargs.values()) if hasattr(each, "op")]
    return walk.broadcast([shape for shape in shapes if shape is not None])


def _uniform(walk: Values, node: Any) -> Shape:
    """Give the same number everywhere: as many of them as are needed."""
    return [walk.factors.new(size) for size in sizes_of(node.meta["val"])]


def _along_axis(walk: Values, node: Any) -> Any:
    """Compute along an axis, all of whose elements count: sums so far, sorting, softmax."""
    given, dims = walk.shape_of(node.args[0]), argument(node, "dims", argument(node, "dim", -1))
    listed = dims if isinstance(dims, list | tuple) else [dims]
    if not listed:  # of the flattened value
        raise ValueError("no axis")
    along = {dim % len(given) for dim in listed}
    for axis in along:
        walk.factors.freeze(given[axis])
    return for_each_value(node, lambda value: _resize(walk, given, sizes_of(value)))


def _resize(walk: Values, given: Shape, sizes: list[int]) -> Shape:
    """Return axes; new ones, whose elements stay, where a size is another one."""
    return [axis if walk.factors.size(axis) == size else walk.factors.new(size, frozen=True)
            for axis, size in zip(given, sizes, strict=True)]  # fmt: skip


def _triangle(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    walk.freeze(given[-2:])
    return given


def _reduce(walk: Values, node: Any) -> Any:
    given, which = walk.shape_of(node.args[0]), argument(node, "dim")
    if node.target._opname in ("max", "min") and argument(node, "other") is not None:
        return _elementwise(walk, node)
    axes = range(len(given)) if which is None or which == [] else ([which] if isinstance(which, int) else which)
    gone, keep = {axis % len(given) for axis in axes}, argument(node, "keepdim", False)
    for axis in gone:
        walk.factors.freeze(given[axis])
    shape = [() if number in gone else axis for number, axis in enumerate(given) if keep or number not in gone]
    return for_each_value(node, lambda _: shape)


def _reshape(walk: Values, node: Any) -> Shape:
    given, sizes = walk.shape_of(node.args[0]), sizes_of(node.meta["val"])
    leaves = list(walk.factors.leaves(factor for axis in given for factor in axis))
    result: Shape = []
    for number, size in enumerate(sizes):
        axis = walk.factors.take_front(leaves, size)
        if axis is None:  # what is left is divided otherwise
            walk.factors.freeze(leaves)
            return [*result, *walk.frozen_axes(sizes[number:])]
        result.append(axis)
    return result


def _reshape_as(walk: Values, node: Any) -> Shape:
    return walk.broadcast([_reshape(walk, node), walk.shape_of(node.args[1])])


def _windows(walk: Values, node: Any) -> Shape:
    """Take pieces of an axis that may overlap."""
    given, sizes = list(walk.shape_of(node.args[0])), sizes_of(node.meta["val"])
    along = node.args[1] % len(given)
    walk.factors.freeze(given[along])
    (given[along],) = walk.frozen_axes(sizes[along : along + 1])
    return [*given, *walk.frozen_axes(sizes[-1:])]


def _counter_values(walk: Values, node: Any) -> Shape:
    """Give numbers that depend on nothing, or on their places."""
    return walk.frozen_axes(sizes_of(node.meta["val"]))


def _one_hot(walk: Values, node: Any) -> Shape:
    return [*walk.shape_of(node.args[0]), *walk.frozen_axes(sizes_of(node.meta["val"])[-1:])]


def _permute(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    return [given[axis] for axis in node.args[1]]


def _transpose(walk: Values, node: Any) -> Shape:
    given = list(walk.shape_of(node.args[0]))
    if node.target._opname == "numpy_T" and len(given) > 2:
        raise ValueError("all axes the other way round")
    one, other = node.args[1:3] if len(node.args) > 2 else (-1, -2)
    if len(given) > 1:
        given[one], given[other] = given[other], given[one]
    return given


def _movedim(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    froms, tos = ([each] if isinstance(each, int) else list(each) for each in node.args[1:3])
    placed = {to % len(given): given[one % len(given)] for one, to in zip(froms, tos, strict=True)}
    gone = {one % len(given) for one in froms}
    others = iter([axis for number, axis in enumerate(given) if number not in gone])
    return [placed[number] if number in placed else next(others) for number in range(len(given))]


def _expand(walk: Values, node: Any) -> Shape:
    """Repeat what has the size 1: its copies are alike, so that some may go."""
    given, sizes = walk.shape_of(node.args[0]), sizes_of(node.meta["val"])
    padded = [()] * (len(sizes) - len(given)) + given
    return [axis if walk.factors.size(axis) == size else walk.factors.new(size)
            for axis, size in zip(padded, sizes, strict=True)]  # fmt: skip


def _repeat(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    stated = [1] * (len(given) - len(node.args[1])) + list(node.args[1])  # of tile, which may state fewer
    padded = [()] * (len(stated) - len(given)) + given
    times = [walk.frozen_axes([1 if isinstance(count, int) and count == 1 else size // walk.factors.size(axis)])[0]
             for count, size, axis in zip(stated, sizes_of(node.meta["val"]), padded, strict=True)]  # fmt: skip
    return [(*copies, *axis) for copies, axis in zip(times, padded, strict=True)]


def _repeat_each(walk: Values, node: Any) -> Shape:
    given, along = list(walk.shape_of(node.args[0])), argument(node, "dim")
    if not isinstance(node.args[1], int) or along is None:
        raise ValueError("not as often each")
    given[along] = (*given[along], *walk.frozen_axes([node.args[1]])[0])
    return given


def _pairs_reduced(walk: Values, node: Any) -> Shape:
    """Compute one number of the elements of two values along an axis."""
    given = walk.broadcast([walk.shape_of(each) for each in node.args[:2]])
    along = argument(node, "dim", -1) % len(given)
    walk.factors.freeze(given[along])
    return [axis for number, axis in enumerate(given) if number != along or argument(node, "keepdim", False)]


def _outer(walk: Values, node: Any) -> Shape:
    return [*walk.shape_of(node.args[0]), *walk.shape_of(node.args[1])]


def _kronecker(walk: Values, node: Any) -> Shape:
    one, other = walk.shape_of(node.args[0]), walk.shape_of(node.args[1])
    rank = max(len(one), len(other))
    padded = ([()] * (rank - len(each)) + each for each in (one, other))
    return [(*slow, *fast) for slow, fast in zip(*padded, strict=True)]


def _select(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    along = node.args[1] % len(given)
    walk.factors.freeze(given[along])
    return [axis for number, axis in enumerate(given) if number != along]


def _index(walk: Values, node: Any) -> Shape:
    """Take elements of one axis by their numbers."""
    given, listed = walk.shape_of(node.args[0]), node.args[1]
    by_name = not isinstance(listed, list | tuple)
    numbers = [node.args[2]] if by_name else [each for each in listed if each is not None]
    if len(numbers) != 1:
        raise ValueError("several axes")
    along = listed % len(given) if by_name else next(at for at, each in enumerate(listed) if each is not None)
    walk.factors.freeze(given[along])
    taken = sizes_of(node.meta["val"])[along : along + len(walk.shape_of(numbers[0]))]
    return [*given[:along], *walk.frozen_axes(taken), *given[along + 1 :]]


def _by_numbers(walk: Values, node: Any) -> Shape:
    """Take or put elements along one axis, each by a number of its own: the other axes go together."""
    values = [walk.shape_of(each) for each in node.all_input_nodes]
    along = argument(node, "dim") % len(values[0])
    for shape in values:
        walk.factors.freeze(shape[along])
    others = walk.broadcast([replace_axis(shape, along, ()) for shape in values])
    return replace_axis(others, along, walk.frozen_axes([sizes_of(node.meta["val"])[along]])[0])


def _scatter_add(walk: Values, node: Any) -> Shape:
    """Add or put a value's elements along one axis, by their numbers."""
    given, along, source = walk.shape_of(node.args[0]), argument(node, "dim"), argument(node, "source")
    put = [walk.shape_of(source)] if hasattr(source, "op") else []
    for shape in (given, *put):
        walk.factors.freeze(shape[along % len(given)])
    walk.broadcast([replace_axis(shape, along, ()) for shape in (given, *put)])
    return given


def _embedding(walk: Values, node: Any) -> Shape:
    weight, ids = walk.shape_of(node.args[0]), walk.shape_of(node.args[1])
    walk.freeze(weight)
    return [*ids, weight[1]]


IDENTITIES = ("alias", "clone", "contiguous", "detach", "dropout", "alpha_dropout", "feature_dropout", "to", "_to_copy",
        "type_as", "lift_fresh_copy")  # fmt: skip
ELEMENTWISE = ("add", "bucketize", "copy", "expand_as", "hardswish", "hardsigmoid", "log_sigmoid", "real", "rsub",
               "rrelu", "selu", "celu", "square", "divide", "multiply", "subtract", "true_divide", "where")  # fmt: skip
"""Those that torch does not tag as elementwise."""
UNIFORM = ("zeros", "ones", "full", "empty", "new_zeros", "new_ones", "new_full", "new_empty",
           "zeros_like", "ones_like", "full_like", "empty_like")  # fmt: skip
REDUCERS = ("mean", "sum", "amax", "amin", "max", "min", "std", "var", "prod", "logsumexp", "linalg_vector_norm",
            "norm", "any", "all", "argmax", "argmin", "median", "nanmedian", "nanmean", "nansum", "mode", "kthvalue",
            "quantile", "aminmax", "var_mean", "std_mean", "count_nonzero")  # fmt: skip
SCANS = ("softmax", "_softmax", "log_softmax", "_log_softmax", "softmin", "cumsum", "cumprod", "sort", "topk",
         "argsort", "flip", "roll", "logcumsumexp", "diff", "fft_fft", "fft_ifft", "fft_rfft", "fft_irfft", "fft_fft2",
         "fft_ifft2", "fft_rfft2", "fft_irfft2")  # fmt: skip
RESHAPES = ("reshape", "view", "_unsafe_view", "flatten", "unflatten", "unsqueeze", "squeeze", "ravel")
COUNTERS = ("arange", "linspace", "logspace", "eye", "scalar_tensor", "tril_indices", "triu_indices")
TRANSPOSES = ("transpose", "t", "mT", "numpy_T", "swapaxes", "swapdims", "adjoint", "mH")
_RULES: dict[str, Rule] = {
    **PRODUCTS, **LAYERS, **SEGMENTS,
    **dict.fromkeys(IDENTITIES, _same), **dict.fromkeys(ELEMENTWISE, _elementwise),
    **dict.fromkeys(UNIFORM[:8], _uniform), **dict.fromkeys(UNIFORM[8:], _same),
    **dict.fromkeys(SCANS, _along_axis), **dict.fromkeys(REDUCERS, _reduce), **dict.fromkeys(RESHAPES, _reshape),
    **dict.fromkeys(("tril", "triu"), _triangle),
    "permute": _permute, **dict.fromkeys(TRANSPOSES, _transpose), **dict.fromkeys(("movedim", "moveaxis"), _movedim),
    **dict.fromkeys(("expand", "broadcast_to"), _expand), **dict.fromkeys(("repeat", "tile"), _repeat),
    "repeat_interleave": _repeat_each, **dict.fromkeys(("reshape_as", "view_as"), _reshape_as), "unfold": _windows,
    **dict.fromkeys(COUNTERS, _counter_values), "one_hot": _one_hot, "outer": _outer, "kron": _kronecker,
    **dict.fromkeys(("linalg_vecdot", "cosine_similarity", "pairwise_distance"), _pairs_reduced),
    "select": _select, "embedding": _embedding,
    **dict.fromkeys(("index", "index_select"), _index),
    **dict.fromkeys(("gather", "scatter", "scatter_add", "scatter_reduce", "take_along_dim"), _by_numbers),
    **dict.fromkeys(("index_add", "index_copy", "index_fill"), _scatter_add),
}  # fmt: skip


def rule_for(target: Any) -> Rule | None:
    """Return what an operator of torch does to axes; None where that is not known here.

    An operator that torch tags as elementwise is one, and one that changes its input gives what its plain form gives.
    """
    name = getattr(target, "_opname", "")  # what computes a size has no name of an operator
    if getattr(target, "namespace", "") != "aten":
        return None
    tags = {tag.name for tag in target.tags}
    pointwise = "pointwise" in tags and not any("nondeterministic" in tag for tag in tags)
    return _RULES.get(name) or _RULES.get(name.removesuffix("_")) or (_elementwise if pointwise else None)
