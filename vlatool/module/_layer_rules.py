"""What normalisations, pooling, interpolation and activations with weights do to the axes of their values."""

from __future__ import annotations

from typing import Any

from vlatool.module._axis_values import Rule, Values, argument, for_each_value, sizes_of
from vlatool.module.factors import Shape


def _channels(walk: Values, node: Any) -> Shape:
    """Treat every channel by itself: batch and instance normalisation, PReLU."""
    given = walk.shape_of(node.args[0])
    for each in node.args[1:5]:
        if hasattr(each, "op"):
            walk.broadcast([[given[1]], walk.shape_of(each)])
    return given


def _in_groups(walk: Values, node: Any) -> Shape:
    """Normalise over groups of channels: a group may go, a part of one may not."""
    given = walk.shape_of(node.args[0])
    groups, inside = walk.factors.split_axis(given[1], node.args[1])
    walk.freeze((inside, *given[2:]))
    for name in ("weight", "bias"):
        walk.unite_argument(node, name, given[1])
    walk.counts[node] = {("num_groups", None): [groups]}
    return given


def _over_last(walk: Values, node: Any) -> Shape:
    """Normalise over the last axes: all of their elements count."""
    given = walk.shape_of(node.args[0])
    for each in node.args[2:4]:
        if hasattr(each, "op"):
            walk.broadcast([given, walk.shape_of(each)])
    walk.freeze(given[-len(node.args[1]) :])
    return given


def _weight_norm(walk: Values, node: Any) -> Shape:
    """Scale the rows of a weight, each of which is normalised."""
    given, along = walk.shape_of(node.args[0]), argument(node, "dim", 0) % len(walk.shape_of(node.args[0]))
    for number, axis in enumerate(given):
        if number != along:
            walk.factors.freeze(axis)
    return walk.broadcast([given, walk.shape_of(node.args[1])])


def _over_space(walk: Values, node: Any) -> Any:
    """Pool or interpolate: batch and channels stay as they are, places become others."""
    given, rank = walk.shape_of(node.args[0]), _rank(node)
    walk.freeze(given[-rank:])
    return for_each_value(node, lambda value: [*given[:-rank], *walk.frozen_axes(sizes_of(value)[-rank:])])


def _unpool(walk: Values, node: Any) -> Any:
    """Put what was pooled back to its places."""
    walk.broadcast([walk.shape_of(each) for each in node.args[:2]])
    return _over_space(walk, node)


def _rank(node: Any) -> int:
    """Return over how many axes an operator pools: the number before the 'd' in its name."""
    return next(rank for rank in (1, 2, 3) if f"{rank}d" in node.target._opname)


def _grid_sample(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    walk.freeze((*given[2:], *walk.shape_of(node.args[1])[1:]))
    return [*given[:2], *walk.frozen_axes(sizes_of(node.meta["val"])[2:])]


def _pixel_shuffle(walk: Values, node: Any) -> Shape:
    """Turn the faster part of the channels into places."""
    given, sizes = walk.shape_of(node.args[0]), sizes_of(node.meta["val"])
    channels, space = walk.factors.split_axis(given[-3], sizes[-3])
    walk.freeze((space, *given[-2:]))
    return [*given[:-3], channels, *walk.frozen_axes(sizes[-2:])]


def _pixel_unshuffle(walk: Values, node: Any) -> Shape:
    """Turn places into the faster part of the channels."""
    given, sizes = walk.shape_of(node.args[0]), sizes_of(node.meta["val"])
    return _patches(walk, given, sizes[-3], sizes[-2:])


def _unfold(walk: Values, node: Any) -> Shape:
    """Let the channels of the places of a patch follow each other."""
    given, sizes = walk.shape_of(node.args[0]), sizes_of(node.meta["val"])
    return _patches(walk, given, sizes[-2], sizes[-1:])


def _patches(walk: Values, given: Shape, size: int, space: list[int]) -> Shape:
    *lead, channels, rows, columns = given
    walk.freeze((rows, columns))
    (patch,) = walk.frozen_axes([size // walk.factors.size(channels)])
    return [*lead, (*channels, *patch), *walk.frozen_axes(space)]


def _fold(walk: Values, node: Any) -> Shape:
    given, sizes = walk.shape_of(node.args[0]), sizes_of(node.meta["val"])
    channels, inside = walk.factors.split_axis(given[-2], sizes[-3])
    walk.freeze((inside, given[-1]))
    return [*given[:-2], channels, *walk.frozen_axes(sizes[-2:])]


def _channel_shuffle(walk: Values, node: Any) -> Shape:
    given = walk.shape_of(node.args[0])
    groups, inside = walk.factors.split_axis(given[1], node.args[1])
    walk.counts[node] = {("groups", None): [groups]}
    return [given[0], (*inside, *groups), *given[2:]]


_POOLS = ("max_pool{}d", "avg_pool{}d", "adaptive_avg_pool{}d", "adaptive_max_pool{}d", "max_pool{}d_with_indices")
_UPSAMPLE_MODES = ("nearest1d", "nearest2d", "nearest3d", "linear1d", "bilinear2d", "trilinear3d", "bicubic2d")
LAYERS: dict[str, Rule] = {
    **dict.fromkeys(("batch_norm", "instance_norm", "prelu"), _channels), "group_norm": _in_groups,
    **dict.fromkeys(("layer_norm", "rms_norm"), _over_last), "_weight_norm": _weight_norm,
    **{pool.format(rank): _over_space for pool in _POOLS for rank in (1, 2, 3)},
    **{f"upsample_{kind}": _over_space for kind in _UPSAMPLE_MODES},
    **{f"_upsample_{kind}": _over_space for kind in ("bilinear2d_aa", "bicubic2d_aa")},
    **{f"_upsample_nearest_exact{rank}d": _over_space for rank in (1, 2, 3)},
    **{f"max_unpool{rank}d": _unpool for rank in (2, 3)},
    "grid_sampler": _grid_sample, "pixel_shuffle": _pixel_shuffle, "pixel_unshuffle": _pixel_unshuffle,
    "im2col": _unfold, "col2im": _fold, "channel_shuffle": _channel_shuffle,
}  # fmt: skip
