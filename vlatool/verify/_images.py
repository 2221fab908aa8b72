"""Explanations of images of a log: red for blue, flipped, of another range, late, or of another camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import TensorSpec
from vlatool.verify._explanation import Explanation
from vlatool.verify._pairing import Pairs

Array = NDArray[np.float32]
Frames = Any
"""Images of a recording, read row by row."""
Change = Callable[[Array], Array]
MAX_FRAMES = 48
GRID = 24
"""Pixels of an axis that are compared."""
BETTER = 0.7
"""Share of the difference (root mean square) that an explanation may leave: beside small colours, noise is a lot."""
MIN_DIFFERENCE = 1 / 255
"""Mean difference, as a share of the range of values, below which two images are the same."""


def is_image(tensor: TensorSpec) -> bool:
    """Return whether an input is images: height, width, and three or four channels as the last or third last axis."""
    sizes = tensor.shape[1:]
    return len(sizes) >= 3 and tensor.kind == "tensor" and channel_axis(tensor) != 0


def channel_axis(tensor: TensorSpec) -> int:
    """Return the axis of the colours, counted from the end; 0 when there is none."""
    return next((axis for axis in (-1, -3) if tensor.shape[axis] in (3, 4)), 0)


def changes_of(tensor: TensorSpec) -> dict[tuple[str, str], Change]:
    """Return kind and words of a wrong image -> what it makes of a right one."""
    channels = channel_axis(tensor)
    rows, columns = (-3, -2) if channels == -1 else (-2, -1)
    return {
        ("", ""): lambda image: image,
        ("bgr", "red and blue are exchanged"): lambda image: np.flip(image, channels),
        ("flipped", "left and right"): lambda image: np.flip(image, columns),
        ("flipped", "upside down"): lambda image: np.flip(image, rows),
        ("flipped", "turned by 180 degrees"): lambda image: np.flip(image, (rows, columns)),
        ("scaled", "0-1 instead of 0-255"): lambda image: image / 255,
        ("scaled", "0-255 instead of 0-1"): lambda image: image * 255,
    }


def small(tensor: TensorSpec, frames: Frames, rows: NDArray[np.int64]) -> Array:
    """Return frames of which every axis of pixels has ``GRID`` elements at most, symmetric so that flips stay exact."""
    channels = channel_axis(tensor)
    axes = (-3, -2) if channels == -1 else (-2, -1)
    return np.stack([_thinned(np.asarray(frames[int(row)], np.float32), axes) for row in rows])


def _thinned(image: Array, axes: tuple[int, int]) -> Array:
    for axis in axes:
        size = image.shape[axis]
        half = np.linspace(0, (size - 1) // 2, GRID // 2).astype(int)
        chosen = np.unique([*half, *(size - 1 - half)])
        image = np.take(image, chosen, axis)
    return image


def explain_images(
    tensor: TensorSpec, log: Frames, references: Mapping[str, Frames], pairings: Mapping[int, Pairs]
) -> tuple[Explanation | None, float]:
    """Return what is wrong with the images of an input, and how unlike they are with it: 0 for equal, 1 for others.

    Args:
        references: name of each input that has images of this shape -> its images in the reference.
    """
    whole = spread_pairs(pairings[0])
    mine = small(tensor, log, whole.log)
    right = small(tensor, references[tensor.name], whole.reference)
    if mine.shape != right.shape:
        return None, 1.0
    levels = max(1.0, float(right.max()))
    unlike = _size(mine - np.roll(right, len(right) // 2, axis=0)) or 1.0
    before = _size(mine - right)
    found = [(error, kind, where, len(whole)) for (kind, where), error in _errors(tensor, mine, right).items() if kind]
    found += [(error, "delayed", f"{delay} control step{'s' if abs(delay) > 1 else ''}", count)
              for delay, error, count in _late(tensor, log, references[tensor.name], pairings)]  # fmt: skip
    others = [name for name, frames in references.items() if name != tensor.name and frames.shape[1:] == log.shape[1:]]
    found += [(_size(mine - small(tensor, references[name], whole.reference)), "swapped", f"it shows '{name}'",
               len(whole)) for name in others]  # fmt: skip
    error, kind, where, count = min(found)
    if before <= MIN_DIFFERENCE * levels or error > BETTER * before:
        return None, before / unlike
    return Explanation(tensor.name, kind, where, before / unlike, error / unlike, count), error / unlike


def spread_pairs(pairs: Pairs) -> Pairs:
    """Return up to ``MAX_FRAMES`` of the pairs, spread over them."""
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MAX_FRAMES)).astype(int))
    return Pairs(pairs.log[chosen], pairs.reference[chosen])


def _errors(tensor: TensorSpec, mine: Array, right: Array) -> dict[tuple[str, str], float]:
    return {words: _size(mine - change(right)) for words, change in changes_of(tensor).items()}


def _late(
    tensor: TensorSpec, log: Frames, reference: Frames, pairings: Mapping[int, Pairs]
) -> Iterator[tuple[int, float, int]]:
    """Yield delay, difference and rows of each delay that can be tried."""
    for delay, pairs in pairings.items():
        if delay:
            some = spread_pairs(pairs)
            error = _size(small(tensor, log, some.log) - small(tensor, reference, some.reference))
            yield delay, error, len(some)


def _size(difference: Array) -> float:
    """Return the root mean square of a difference."""
    return float(np.sqrt(np.mean(difference**2)))
