"""Quantize weights in blocks along the input axis, each with its own scale and zero point.

The arithmetic works on *planes*: a float32 array (block, n) whose column is one block, its even elements first, then
its odd ones. Every operation then runs along contiguous memory, and the two halves are what a byte of int4 packs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
FACTORS = (1.06, 0.97)
"""Shares of a block's range that the scale search tries."""
TINY = 1e-30
"""A block whose range is below this becomes zeros."""
HQQ_ROUNDS = 20
HQQ_NORM, HQQ_BETA, HQQ_GROWTH = 0.7, 10.0, 1.01


@dataclass(frozen=True)
class Format:
    """How a weight is stored.

    Args:
        bits: 4 or 8.
        block: Weights that share a scale: 32, 64 or 128.
        symmetric: Whether the zero point is fixed in the middle (8 or 128).
    """

    bits: int = 4
    block: int = 32
    symmetric: bool = False

    @property
    def levels(self) -> int:
        """The largest code: 15 or 255."""
        return int(2**self.bits) - 1

    @property
    def middle(self) -> int:
        """The code of zero when symmetric: 8 or 128."""
        return int(2 ** (self.bits - 1))

    @property
    def bytes(self) -> int:
        """Bytes of the codes of one block."""
        return self.block * self.bits // 8

    @property
    def largest_error(self) -> float:
        """Bound on the relative L2 error of weights that were rounded to the nearest code, whatever their values.

        A weight is half a step off at most, and a step is at most twice the largest magnitude of its block over the
        levels; the norm of the block is at least that magnitude.
        """
        return float(np.sqrt(self.block)) / self.levels


class Chosen(NamedTuple):
    """Scale (n,) float32 and zero point (n,) float32 holding whole numbers, of each block."""

    scale: Array
    zero: Array


class Quantized(NamedTuple):
    """Blocks as they are stored.

    Args:
        codes: (n, bytes) uint8; for int4 the even element in the low half of a byte.
        scale: (n,) float32.
        zero: (n,) uint8.
        squared_error: Sum of the squared differences to the weights, from the stored codes.
        squared_norm: Sum of the squared weights.
    """

    codes: Array
    scale: Array
    zero: Array
    squared_error: float
    squared_norm: float


Choose = Callable[[Array, Format, "Scratch"], Chosen]


class Scratch:
    """Buffers of one thread, by name; reused, since fresh pages cost more than the arithmetic."""

    def __init__(self) -> None:
        self._buffers: dict[str, Array] = {}

    def __call__(self, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> Array:
        """Return an array with undefined content."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        held = self._buffers.get(name)
        if held is None or held.nbytes < size:
            held = self._buffers[name] = np.empty(size, np.uint8)
        shaped: Array = held[:size].view(dtype).reshape(shape)
        return shaped


def planes_of(stored: Array, dtype: str, block: int, scratch: Scratch) -> Array:
    """Convert stored weights to planes.

    Args:
        stored: (n * block * itemsize,) uint8, the blocks one after the other.
        dtype: ``BF16``, ``F16`` or ``F32``.

    Returns:
        (block, n) float32, valid until the next call with the same scratch.
    """
    half = block // 2
    if dtype == "F32":
        rows = stored.view(np.float32).reshape(-1, block)
        planes = scratch("planes", (block, len(rows)))
        planes[:half], planes[half:] = rows[:, 0::2].T, rows[:, 1::2].T
        return planes
    pairs = stored.view(np.uint32).reshape(-1, half)
    turned = scratch("pairs", (half, len(pairs)), np.uint32)
    np.copyto(turned, pairs.T)
    planes = scratch("planes", (block, len(pairs)))
    if dtype == "BF16":
        words = planes.view(np.uint32)
        np.left_shift(turned, 16, out=words[:half])
        np.bitwise_and(turned, np.uint32(0xFFFF0000), out=words[half:])
        return planes
    halves = turned.view(np.float16).reshape(half, -1, 2)
    planes[:half], planes[half:] = halves[:, :, 0], halves[:, :, 1]
    return planes


def planes_of_rows(rows: Array, scratch: Scratch) -> Array:
    """Convert (block, n) weights whose first axis is the input axis to planes."""
    half = len(rows) // 2
    planes = scratch("planes", rows.shape)
    planes[:half], planes[half:] = rows[0::2], rows[1::2]
    return planes


def rounded(planes: Array, form: Format, scratch: Scratch) -> Chosen:
    """Choose scale and zero point by the range of each block, which always holds 0 (round to nearest)."""
    scale, low = _range(planes, form)
    return Chosen(scale, _zero(scale, low, form))


def _range(planes: Array, form: Format) -> tuple[Array, Array]:
    """Return the scale that spans each block and its lowest value (0 when all are above)."""
    high: Array = np.maximum.reduce(planes, 0)
    low: Array = np.minimum.reduce(planes, 0)
    if form.symmetric:
        extreme = np.where(high > -low, high, low)
        flat = np.abs(extreme) < TINY
        return np.where(flat, 1, extreme / -form.middle).astype(np.float32), low
    np.maximum(high, 0, out=high)
    np.minimum(low, 0, out=low)
    np.subtract(high, low, out=high)
    np.divide(high, np.float32(form.levels), out=high)
    high[high < TINY] = 1
    return high, low


def _zero(scale: Array, low: Array, form: Format) -> Array:
    """Return the code of zero for blocks that begin at ``low``."""
    if form.symmetric:
        return np.full_like(low, form.middle)
    zero: Array = np.rint(low / -scale)
    return np.minimum(zero, np.float32(form.levels), out=zero)


def searched(planes: Array, form: Format, scratch: Scratch) -> Chosen:
    """Round to nearest, with the range of ``FACTORS`` and the scale that lose least in each block.

    For given codes the best scale is a quotient of two sums, and so is what it gains; the codes with the largest gain
    win.
    """
    spanned, low = _range(planes, form)
    best = Chosen(spanned, low)
    gained = np.full_like(spanned, -np.inf)
    for factor in FACTORS:
        scale = spanned * np.float32(factor)
        zero = _zero(scale, low, form)
        along, power = _fit(planes, encode(planes, Chosen(scale, zero), form, scratch))
        fitted = along / power
        gain = along * fitted
        better = gain > gained
        best = Chosen(np.where(better, fitted, best.scale), np.where(better, zero, best.zero))
        np.maximum(gained, gain, out=gained)
    flat = np.abs(best.scale) < TINY
    return Chosen(np.where(flat, spanned, best.scale), best.zero) if flat.any() else best


def half_quadratic(planes: Array, form: Format, scratch: Scratch) -> Chosen:
    """Choose the zero point that minimises a norm of the error below 1, robust to outliers (HQQ, Badri and Shaji 2023).

    The zero point is rounded to a whole number, which the integer kernels need, and the scale fitted to it.
    """
    scale, zero = rounded(planes, form, scratch)
    beta = HQQ_BETA
    off: Array
    for _ in range(0 if form.symmetric else HQQ_ROUNDS):
        codes = np.clip(np.rint(planes / scale + zero), 0, form.levels)
        off = planes - (codes - zero) * scale
        size = np.abs(off)
        shrunk = np.sign(off) * np.maximum(size - np.power(size + 1e-12, HQQ_NORM - 1) / np.float32(beta), 0)
        zero = np.add.reduce(codes - (planes - shrunk) / scale, axis=0) / np.float32(form.block)
        beta *= HQQ_GROWTH
    zero = np.clip(np.rint(zero), 0, form.levels)
    along, power = _fit(planes, encode(planes, Chosen(scale, zero), form, scratch))
    fitted = along / power
    usable = np.isfinite(fitted) & (np.abs(fitted) > TINY)
    return Chosen(np.where(usable, fitted, scale).astype(np.float32), zero)


def _fit(planes: Array, codes: Array) -> tuple[Array, Array]:
    """Return, for each block, weights times codes and codes times codes (at least 1): their ratio is the best scale."""
    along = np.einsum("ij,ij->j", planes, codes)
    return along, np.maximum(np.einsum("ij,ij->j", codes, codes), np.float32(1))


def encode(planes: Array, chosen: Chosen, form: Format, scratch: Scratch) -> Array:
    """Return codes less their zero point, (block, n) float32 of whole numbers, valid until the next call."""
    codes = scratch("codes", planes.shape)
    np.multiply(planes, np.float32(1) / chosen.scale, out=codes)
    np.maximum(codes, -chosen.zero, out=codes)
    np.minimum(codes, np.float32(form.levels) - chosen.zero, out=codes)
    return np.rint(codes, out=codes)


def pack(codes: Array, zero: Array, form: Format, scratch: Scratch, out: Array) -> None:
    """Store codes less their zero point, (block, n), as (n, bytes) uint8 into ``out``, which may be strided."""
    half = form.block // 2
    np.add(codes, zero, out=codes)
    small = scratch("small", codes.shape, np.uint8)
    np.copyto(small, codes, casting="unsafe")
    if form.bits == 8:
        out[:, 0::2], out[:, 1::2] = small[:half].T, small[half:].T
        return
    np.left_shift(small[half:], 4, out=small[half:])
    np.bitwise_or(small[:half], small[half:], out=small[:half])
    np.copyto(out, small[:half].T)


def unpack(stored: Array, form: Format, scratch: Scratch) -> Array:
    """Return the codes of (n, bytes) uint8 as planes (block, n) uint8."""
    half = form.block // 2
    codes = scratch("unpacked", (form.block, len(stored)), np.uint8)
    if form.bits == 8:
        codes[:half], codes[half:] = stored[:, 0::2].T, stored[:, 1::2].T
        return codes
    np.copyto(codes[:half], stored.T)
    np.right_shift(codes[:half], 4, out=codes[half:])
    np.bitwise_and(codes[:half], 15, out=codes[:half])
    return codes


def quantize_planes(
    planes: Array, form: Format, choose: Choose, scratch: Scratch, out: Array | None = None
) -> Quantized:
    """Quantize planes and measure what the stored codes lose.

    Args:
        planes: (block, n) float32.
        choose: How scale and zero point are found.
        out: (n, bytes) uint8 to write the codes to, may be strided.

    Returns:
        The blocks; ``squared_norm`` is not finite when a weight is not.
    """
    norm = float(np.vdot(planes, planes))
    codes = np.empty((planes.shape[1], form.bytes), np.uint8) if out is None else out
    if not np.isfinite(norm):
        wide = planes.astype(np.float64)
        norm = float(np.vdot(wide, wide))
    if not np.isfinite(norm):
        return Quantized(codes, planes[0], planes[0], norm, norm)
    chosen = choose(planes, form, scratch)
    pack(encode(planes, chosen, form, scratch), chosen.zero, form, scratch, codes)
    lost = squared_error(planes, codes, chosen, form, scratch)
    return Quantized(codes, chosen.scale, chosen.zero.astype(np.uint8), lost, norm)


def squared_error(planes: Array, stored: Array, chosen: Chosen, form: Format, scratch: Scratch) -> float:
    """Return the sum of squared differences between planes and what the stored codes mean."""
    meant = scratch("codes", planes.shape)
    np.subtract(unpack(stored, form, scratch), chosen.zero, out=meant)
    np.multiply(meant, chosen.scale, out=meant)
    np.subtract(meant, planes, out=meant)
    return float(np.vdot(meant, meant))


def pack_zeros(zero: Array, form: Format) -> Array:
    """Return zero points (rows, blocks) uint8 as ONNX Runtime stores them: (rows, ceil(blocks * bits / 8)) uint8."""
    if form.bits == 8:
        return zero
    even, odd = zero[:, 0::2], zero[:, 1::2]
    if odd.shape[1] < even.shape[1]:
        odd = np.pad(odd, ((0, 0), (0, 1)))
    packed: Array = even | (odd << 4)
    return packed


def unpack_zeros(packed: Array, count: int, form: Format) -> Array:
    """Undo ``pack_zeros``: (rows, count) uint8."""
    if form.bits == 8:
        return packed
    return np.stack([packed & 15, packed >> 4], axis=2).reshape(len(packed), -1)[:, :count]


def dequantize(stored: Array, scale: Array, zero: Array, form: Format) -> Array:
    """Return (n, block) float32 of the meaning of blocks, in their natural order."""
    planes: Array = unpack(stored, form, Scratch()).astype(np.float32)
    planes = (planes - zero.astype(np.float32)) * scale
    half = form.block // 2
    natural = np.empty((planes.shape[1], form.block), np.float32)
    natural[:, 0::2], natural[:, 1::2] = planes[:half].T, planes[half:].T
    return natural


METHODS: dict[str, Choose] = {"rtn": rounded, "searched": searched, "hqq": half_quadratic}
