"""Pictures of another size, as PIL, OpenCV and torch compute them: numpy alone, both axes one after the other.

Each element of a resized axis is a weighted sum of neighbours, so an axis is a banded matrix, multiplied block by block
in float32. Where a library computes in integers, the products here are integers below 2^24, which float32 holds
exactly: the result has the same bits. PIL: ``src/libImaging/Resample.c``; OpenCV: ``imgproc/src/resize.cpp``; torch:
``aten/src/ATen/native/cpu/UpSampleKernel.cpp``.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats = NDArray[np.float64]
Planes = NDArray[np.float32]
Taps = tuple[NDArray[np.int64], Floats]
"""Indices (n, taps) of the elements that each result is a sum of, and their weights (n, taps)."""
BLOCK = 8
"""Results of an axis that one product of matrices gives."""
EXACT = 1 << 24
"""Integers below are exact in float32."""
SPLIT = 256.0
"""Weights that are too large for float32 are divided by this into a high and a low part."""
GRID = 1024.0
"""Steps of a value that is rounded, in each whole number: errors of sums in float32 are far below half of one."""
SUPPORT = {"area": 0.5, "bilinear": 1.0, "bicubic": 2.0, "lanczos": 3.0}
"""Reach of a filter to each side, in elements of the input."""


def resampler(
    library: str, kind: str, antialias: bool, before: tuple[int, int], after: tuple[int, int]
) -> Callable[[Array], Array]:
    """Return a function from a picture (H, W, C) to one of another size (h, w, C).

    Args:
        library: whose result is meant: ``pil``, ``pil13``, ``opencv``, ``torch`` (floats) or ``torch_uint8``.
        kind: ``nearest``, ``bilinear``, ``bicubic``, ``area`` or ``lanczos``.
        antialias: whether torch's filters grow with the scale, as PIL's always do.
        before: height and width of the picture.
        after: those of the result.

    Returns:
        A function; its result is float32, holding whole numbers from 0 to 255 except for ``torch``; that of ``nearest``
        has the dtype of the picture. Several threads may call it.
    """
    axes = list(zip(before, after, strict=True))
    if before == after:
        return lambda picture: picture
    if kind == "nearest":
        rows, columns = (_nearest(library, n, m) for n, m in axes)
        return lambda picture: picture[rows][:, columns]
    if library.startswith("pil"):
        return _Resampler([_IntegerPass(*_pil(kind, n, m)) for n, m in axes], _pil_order(library, axes))
    if library == "torch_uint8" and kind != "area":
        return _Resampler([_IntegerPass(*_torch_uint8(kind, antialias, n, m)) for n, m in axes])
    if library == "opencv":
        return _opencv(kind, axes)
    return _Resampler([_FloatPass(_torch(kind, antialias, n, m)) for n, m in axes], rounded=library == "torch_uint8")


class _Scratch(threading.local):
    """Memory that each thread uses again for the next picture: what is new to a process costs it more than the work."""

    def __init__(self) -> None:
        self._arrays: dict[str, Array] = {}

    def __call__(self, name: str, *shape: int, dtype: type[np.generic] = np.float32) -> Array:
        if name not in self._arrays or self._arrays[name].shape != shape:
            self._arrays[name] = np.empty(shape, dtype)
        return self._arrays[name]


class _Resampler:
    """Both axes of a picture, one after the other: (H, W, C) to float32 (h, w, C).

    Args:
        passes: of the rows and of the columns.
        vertical_first: whether the rows are the first axis; otherwise, the columns.
        rounded: whether the result is rounded to whole numbers from 0 to 255.
    """

    def __init__(self, passes: Sequence[_Pass], vertical_first: bool = False, rounded: bool = False) -> None:
        self._passes, self._vertical_first, self._rounded = passes, vertical_first, rounded
        self._scratch = _Scratch()

    def __call__(self, picture: Array) -> Array:
        scratch, (rows, columns) = self._scratch, self._passes
        if self._vertical_first:  # as if the picture lay on its side
            picture, (columns, rows) = picture.transpose(1, 0, 2), self._passes
        channels = picture.shape[2]
        planes = _planes(picture, scratch("planes", channels, *picture.shape[:2]))
        half = columns(planes, scratch("half", columns.size, channels, len(picture)), scratch)
        result = rows(half, np.empty((rows.size, columns.size, channels), np.float32), scratch)
        if self._vertical_first:
            result = result.transpose(1, 0, 2)
        return _whole(result) if self._rounded else result


def _whole(values: Planes) -> Planes:
    """Round to whole numbers from 0 to 255, in place: a half to the even one, whichever processor summed it up.

    Products of matrices add in an order of their own on each processor, so that a sum of thirds that is a half is a
    little more on one and less on another. Rounded to GRID first, which is wider than these errors, it is a half again.
    """
    values *= GRID
    np.rint(values, out=values)
    values *= 1 / GRID
    return np.clip(np.rint(values, out=values), 0, 255, out=values)


class _FloatPass:
    """One axis as a banded matrix: (..., n) to (m, ...), the axis last before and first after."""

    def __init__(self, taps: Taps) -> None:
        self.size, self._bands = len(taps[0]), _bands(taps[0], [taps[1]], np.float32)

    def __call__(self, values: Planes, out: Planes, scratch: _Scratch) -> Planes:
        rows = values.reshape(-1, values.shape[-1])
        into = out.reshape(self.size, len(rows))
        for start, low, high, matrix in self._bands:
            np.matmul(matrix, rows[:, low:high].T, out=into[start : start + len(matrix)])
        return out


class _IntegerPass:
    """One axis in integers, as C computes it: ``clip((sum(weight * pixel) + half) >> bits)``.

    Weights that are too large for float32 are a high and a low part, whose sums are exact. Where even those are not,
    because a result is the sum of hundreds of pixels, float64 holds them whole.

    Args:
        taps: weights are whole numbers.
        bits: by which a sum is shifted.
    """

    def __init__(self, taps: Taps, bits: int) -> None:
        index, weights = taps
        high = np.floor(weights / SPLIT)
        parts = [weights] if _holds(weights) else [weights - high * SPLIT, high]
        exact = all(map(_holds, parts))
        self.size, self._bits, self._clips = len(index), bits, bool((weights < 0).any())
        self._bands = _bands(index, parts if exact else [weights], np.float32 if exact else np.float64)
        self._split, self._exact = exact and len(parts) == 2, exact

    def __call__(self, values: Planes, out: Planes, scratch: _Scratch) -> Planes:
        rows = values.reshape(-1, values.shape[-1])
        into = out.reshape(self.size, len(rows))
        if not self._exact:
            rows = rows.astype(np.float64)
        for start, low, high, matrix in self._bands:
            count = len(matrix) >> self._split
            sums = scratch(f"sums{len(matrix)}", len(matrix), len(rows)) if self._exact else None
            sums = np.matmul(matrix, rows[:, low:high].T, out=sums)
            self._shift(sums, into[start : start + count])
        return np.clip(out, 0, 255, out=out) if self._clips else out

    def _shift(self, sums: NDArray[np.floating], out: Planes) -> None:
        """Write ``(sums + half) >> bits``; of two parts: ``(high * 256 + low + half) >> bits``."""
        bits = self._bits
        if self._split:
            low, high = sums[: len(out)], sums[len(out) :]
            low *= 1 / SPLIT
            sums, bits = np.add(np.floor(low, out=low), high, out=low), bits - 8
        sums += 1 << (bits - 1)
        sums *= 0.5**bits
        np.floor(sums, out=out, casting="same_kind")


_Pass = _FloatPass | _IntegerPass


def _holds(weights: Floats) -> bool:
    """Return whether float32 holds every sum of whole weights times pixels, and half of the last bit on top."""
    return bool(255 * np.abs(weights).sum(1).max() < EXACT / 2)


def _bands(
    index: NDArray[np.int64], parts: Sequence[Floats], dtype: type[np.floating]
) -> list[tuple[int, int, int, NDArray[np.floating]]]:
    """Return the blocks of a banded matrix: first result, range of elements, and weights (results, elements).

    Args:
        index: (m, taps).
        parts: of the weights (m, taps); those of a block are below each other.
    """
    bands = []
    for start in range(0, len(index), BLOCK):
        some = index[start : start + BLOCK]
        low, high = int(some.min()), int(some.max()) + 1
        matrix = np.zeros((len(parts), len(some), high - low))
        for part, weights in zip(matrix, parts, strict=True):
            np.add.at(part, (np.arange(len(some))[:, None], some - low), weights[start : start + BLOCK])
        bands.append((start, low, high, matrix.reshape(-1, high - low).astype(dtype)))
    return bands


def _planes(picture: Array, planes: Planes) -> Planes:
    """Write a picture (H, W, C) as float32 (C, H, W): an axis is multiplied where it is the last one."""
    for channel, plane in enumerate(planes):
        plane[...] = picture[:, :, channel]
    return planes


def _cubic(distance: Floats, a: float) -> Floats:
    """Keys' cubic kernel; ``a`` is -0.5 (PIL, torch with antialias) or -0.75 (OpenCV, torch)."""
    x = np.abs(distance)
    near, far = ((a + 2) * x - (a + 3)) * x * x + 1, (((x - 5) * x + 8) * x - 4) * a
    return np.where(x < 1, near, np.where(x < 2, far, 0.0))


def _kernel(kind: str, distance: Floats) -> Floats:
    """Return the weights of an antialiasing filter."""
    if kind == "area":
        return np.asarray((distance > -0.5) & (distance <= 0.5), np.float64)
    if kind == "bilinear":
        return np.asarray(np.maximum(0.0, 1 - np.abs(distance)))
    if kind == "bicubic":
        return _cubic(distance, -0.5)
    return np.where(np.abs(distance) < 3, np.sinc(distance) * np.sinc(distance / 3), 0.0)


def _growing(kind: str, n: int, m: int) -> Taps:
    """Taps of a filter that grows with the scale, in elements of the input, as PIL and torch compute them."""
    scale = n / m
    wide = max(scale, 1.0)
    support = SUPPORT[kind] * wide
    centre = (np.arange(m) + 0.5) * scale
    low = np.maximum((centre - support + 0.5).astype(np.int64), 0)
    high = np.minimum((centre + support + 0.5).astype(np.int64), n)
    index = low[:, None] + np.arange(int((high - low).max()))
    weights = _kernel(kind, (index - centre[:, None] + 0.5) / wide) * (index < high[:, None])
    return np.minimum(index, n - 1), weights / weights.sum(1, keepdims=True)


def _pil(kind: str, n: int, m: int) -> tuple[Taps, int]:
    bits = 22
    index, weights = _growing(kind, n, m)
    return (index, np.trunc(weights * (1 << bits) + np.copysign(0.5, weights))), bits


def _pil_order(library: str, axes: Sequence[tuple[int, int]]) -> bool:
    """Return whether PIL resizes the rows first: from version 13 on, where it takes away many more of them."""
    (height, rows), (width, columns) = axes
    return library == "pil13" and height - rows > max(0, 2 * (width - columns))


def _torch_uint8(kind: str, antialias: bool, n: int, m: int) -> tuple[Taps, int]:
    index, weights = _growing(kind, n, m) if antialias else _fixed(kind, n, m)
    for tap in range(1, weights.shape[1]):  # what counts again beyond an edge is one weight before it is rounded
        again = index[:, tap] == index[:, tap - 1]
        weights[again, tap] += weights[again, tap - 1]
        weights[again, tap - 1] = 0
    bits = 0
    while bits < 22 and 0.5 + weights.max() * (1 << (bits + 1)) < 1 << 15:
        bits += 1
    return (index, np.trunc(weights * (1 << bits) + np.copysign(0.5, weights))), bits


def _torch(kind: str, antialias: bool, n: int, m: int) -> Taps:
    if kind == "area":
        return _averages(n, m)
    return _growing(kind, n, m) if antialias else _fixed(kind, n, m)


def _fixed(kind: str, n: int, m: int) -> Taps:
    """Taps of a filter that does not grow with the scale; beyond the edge, the last element counts again."""
    position = (np.arange(m) + 0.5) * (n / m) - 0.5
    if kind == "bilinear":
        position = np.maximum(position, 0.0)
    first = np.floor(position)
    part = position - first
    reach = range(2) if kind == "bilinear" else range(-1, 3)
    index = np.stack([first + step for step in reach], 1).astype(np.int64)
    if kind == "bilinear":
        weights = np.stack([1 - part, part], 1)
    else:
        weights = np.stack([_cubic(part - step, -0.75) for step in reach], 1)
    return np.clip(index, 0, n - 1), weights


def _averages(n: int, m: int) -> Taps:
    """Means of all elements that a result touches (``adaptive_avg_pool2d``)."""
    low, high = np.arange(m) * n // m, -(-np.arange(1, m + 1) * n // m)
    index = low[:, None] + np.arange(int((high - low).max()))
    weights = (index < high[:, None]) / (high - low)[:, None]
    return np.minimum(index, n - 1), weights


def _nearest(library: str, n: int, m: int) -> NDArray[np.int64]:
    if library.startswith("pil"):  # its affine transform adds the step up
        position = np.cumsum(np.concatenate([[0.5 * (n / m)], np.full(m - 1, n / m)]))
    elif library == "opencv":
        position = np.arange(m) * (1 / (m / n))
    else:
        position = (np.arange(m, dtype=np.float32) * np.float32(n / m)).astype(np.float64)
    return np.minimum(position.astype(np.int64), n - 1)


def _opencv(kind: str, axes: Sequence[tuple[int, int]]) -> Callable[[Array], Array]:
    """Return OpenCV's resize of uint8: linear in integers; cubic and area in floats, rounded at the end."""
    shrinks, halves = all(n >= m for n, m in axes), all(n == 2 * m for n, m in axes)
    if (kind == "area" and shrinks) or (kind == "bilinear" and halves):
        return _opencv_area(axes)
    if kind == "bicubic":
        return _Resampler([_FloatPass(_fixed(kind, n, m)) for n, m in axes], rounded=True)
    return _OpenCvLinear(axes, area=kind == "area")


def _opencv_area(axes: Sequence[tuple[int, int]]) -> Callable[[Array], Array]:
    count = math.prod(n // m for n, m in axes)
    if any(n % m for n, m in axes) or 255 * count >= EXACT:
        return _Resampler([_FloatPass(_overlaps(n, m)) for n, m in axes], rounded=True)
    sums = _Resampler([_FloatPass(_overlaps(n, m, 1.0)) for n, m in axes])
    if all(n == 2 * m for n, m in axes):  # (a + b + c + d + 2) >> 2
        return lambda picture: np.floor((sums(picture) + 2) * 0.25)
    return lambda picture: np.rint(sums(picture) * np.float32(1 / count))


def _overlaps(n: int, m: int, weight: float | None = None) -> Taps:
    """Weights by the part of each element that a result covers; what covers less than a thousandth counts for none."""
    scale = 1 / (m / n)
    begin = np.arange(m) * scale
    end = np.minimum(begin + scale, n)
    low = np.floor(begin + 1e-9).astype(np.int64)
    index = low[:, None] + np.arange(math.ceil(scale - 1e-9) + 1)
    covered = np.minimum(index + 1, end[:, None]) - np.maximum(index, begin[:, None])
    covered = np.where(covered > 1e-3, covered, 0.0)
    each = np.minimum(scale, n - begin)[:, None]
    weights = covered / each if weight is None else np.where(covered > 0, weight, 0.0)
    return np.minimum(index, n - 1), np.asarray(weights, np.float64)


class _OpenCvLinear:
    """``INTER_LINEAR`` of uint8: weights of 11 bits, and a sum of two rows that are shifted by 4 and 16 bits first."""

    def __init__(self, axes: Sequence[tuple[int, int]], *, area: bool) -> None:
        (height, rows), (width, columns) = axes
        first, part = _positions(width, columns, area)
        part[(first < 0) | (first >= width - 1)] = 0
        index = np.clip(np.stack([first, np.maximum(first, 0) + 1], 1), 0, width - 1)
        self._columns = _FloatPass((index, _eleven_bits(part)))
        first, part = _positions(height, rows, area)
        pairs = np.clip(np.stack([first, first + 1]), 0, height - 1)
        needed = np.unique(pairs)
        self._needed = needed if 2 * len(needed) < height else None  # to choose rows costs more than a few too many
        self._pairs = pairs if self._needed is None else np.searchsorted(needed, pairs)
        self._weights = _eleven_bits(part).T[:, :, None, None].astype(np.int32)
        self._scratch = _Scratch()

    def __call__(self, picture: Array) -> Array:
        picture = picture if self._needed is None else picture[self._needed]
        scratch, (rows, columns, channels) = self._scratch, picture.shape
        planes = _planes(picture, scratch("planes", channels, rows, columns))
        sums = self._columns(planes, scratch("half", self._columns.size, channels, rows), scratch)
        sums *= 1 / 16
        shifted = scratch("shifted", rows, self._columns.size, channels, dtype=np.int32)
        shifted[...] = sums.transpose(2, 0, 1)
        shape = (self._pairs.shape[1], *shifted.shape[1:])
        pair = [scratch(name, *shape, dtype=np.int32) for name in ("below", "above")]
        for part, at, weight in zip(pair, self._pairs, self._weights, strict=True):
            np.take(shifted, at, axis=0, out=part, mode="clip")
            part *= weight
            part >>= 16
        below, above = pair
        below += above
        below += 2
        below >>= 2
        return np.asarray(below, np.float32)


def _positions(n: int, m: int, area: bool) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the element below each result, and how far beyond it the result is (0-1)."""
    inverse = m / n
    scale, index = 1 / inverse, np.arange(m)
    if area:
        first = np.floor(index * scale).astype(np.int64)
        part = ((index + 1) - (first + 1) * inverse).astype(np.float32)
        return first, np.asarray(np.where(part <= 0, 0, part - np.floor(part)), np.float32)
    position = ((index + 0.5) * scale - 0.5).astype(np.float32)
    below = np.floor(position)
    return below.astype(np.int64), np.asarray(position - below, np.float32)


def _eleven_bits(part: NDArray[np.float32]) -> Floats:
    one, steps = np.float32(1), np.float32(1 << 11)
    return np.stack([np.rint((one - part) * steps), np.rint(part * steps)], 1).astype(np.float64)
