"""Quantize weights in blocks along the input axis, each with its own scale and zero point.

The arithmetic works on *planes*: a float32 array (block, n) with one block in each column, its even elements first,
then its odd ones. Every operation then runs along contiguous memory, and a byte of int4 packs one element of each half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vlatool.runtime.interface import Array

RANGE_FACTORS = (1.06, 0.97)
"""Candidates of the scale search, relative to the range of a block."""
NEGLIGIBLE_RANGE = 1e-30
"""Range below which a block becomes zeros."""
HQQ_ROUNDS = 20
HQQ_NORM, HQQ_BETA, HQQ_GROWTH = 0.7, 10.0, 1.01


@dataclass(frozen=True)
class BlockFormat:
    """Storage format of a weight.

    Args:
        bits: 4 or 8.
        block: Number of weights that share a scale: 32, 64 or 128.
        symmetric: Whether the zero point is fixed at the midpoint (8 or 128).
    """

    bits: int = 4
    block: int = 32
    symmetric: bool = False

    @property
    def levels(self) -> int:
        """The largest code: 15 or 255."""
        return int(2**self.bits) - 1

    @property
    def midpoint(self) -> int:
        """The code of zero when symmetric: 8 or 128."""
        return int(2 ** (self.bits - 1))

    @property
    def code_bytes(self) -> int:
        """Bytes of the codes of one block."""
        return self.block * self.bits // 8

    @property
    def largest_error(self) -> float:
        """Bound on the relative L2 error of any weights after rounding to the nearest code.

        A weight is off by half a step at most, and a step is at most twice the largest magnitude of its block divided
        by the levels; the norm of the block is at least that magnitude.
        """
        return float(np.sqrt(self.block)) / self.levels


class BlockParameters(NamedTuple):
    """Scale (n,) float32 and zero point (n,) of integers in float32, of each block."""

    scale: Array
    zero: Array


class QuantizedBlocks(NamedTuple):
    """Quantized blocks in storage format.

    Args:
        codes: (n, bytes) uint8; for int4 the even element in the low half of a byte.
        scale: (n,) float32.
        zero: (n,) uint8.
        squared_error: Sum of the squared differences between weights and stored codes.
        squared_norm: Sum of the squared weights.
    """

    codes: Array
    scale: Array
    zero: Array
    squared_error: float
    squared_norm: float


ParameterChoice = Callable[[Array, BlockFormat, "Scratch"], BlockParameters]


class Scratch:
    """Named buffers of one thread; reused, since fresh pages cost more than the arithmetic."""

    def __init__(self) -> None:
        self._buffers: dict[str, Array] = {}

    def __call__(self, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> Array:
        """Return an uninitialized array."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        held = self._buffers.get(name)
        if held is None or held.nbytes < size:
            held = self._buffers[name] = np.empty(size, np.uint8)
        shaped: Array = held[:size].view(dtype).reshape(shape)
        return shaped


def planes_from_bytes(stored: Array, dtype: str, block: int, scratch: Scratch) -> Array:
    """Convert stored weights to planes.

    Args:
        stored: (n * block * itemsize,) uint8, consecutive blocks.
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
    transposed = scratch("pairs", (half, len(pairs)), np.uint32)
    np.copyto(transposed, pairs.T)
    planes = scratch("planes", (block, len(pairs)))
    if dtype == "BF16":
        words = planes.view(np.uint32)
        np.left_shift(transposed, 16, out=words[:half])
        np.bitwise_and(transposed, np.uint32(0xFFFF0000), out=words[half:])
        return planes
    halves = transposed.view(np.float16).reshape(half, -1, 2)
    planes[:half], planes[half:] = halves[:, :, 0], halves[:, :, 1]
    return planes


def planes_from_rows(rows: Array, scratch: Scratch) -> Array:
    """Convert (block, n) weights with the input axis first to planes."""
    half = len(rows) // 2
    planes = scratch("planes", rows.shape)
    planes[:half], planes[half:] = rows[0::2], rows[1::2]
    return planes


def range_parameters(planes: Array, form: BlockFormat, scratch: Scratch) -> BlockParameters:
    """Choose scale and zero point by the range of each block, which always includes 0 (round to nearest)."""
    scale, low = _block_ranges(planes, form)
    return BlockParameters(scale, _zero_points(scale, low, form))


def _block_ranges(planes: Array, form: BlockFormat) -> tuple[Array, Array]:
    """Return the scale that spans each block, and the minimum of the block and 0."""
    high: Array = np.maximum.reduce(planes, 0)
    low: Array = np.minimum.reduce(planes, 0)
    if form.symmetric:
        extreme = np.where(high > -low, high, low)
        flat = np.abs(extreme) < NEGLIGIBLE_RANGE
        return np.where(flat, 1, extreme / -form.midpoint).astype(np.float32), low
    np.maximum(high, 0, out=high)
    np.minimum(low, 0, out=low)
    np.subtract(high, low, out=high)
    np.divide(high, np.float32(form.levels), out=high)
    high[high < NEGLIGIBLE_RANGE] = 1
    return high, low


def _zero_points(scale: Array, low: Array, form: BlockFormat) -> Array:
    """Return the code of zero for blocks with minimum ``low``."""
    if form.symmetric:
        return np.full_like(low, form.midpoint)
    zero: Array = np.rint(low / -scale)
    return np.minimum(zero, np.float32(form.levels), out=zero)


def searched_parameters(planes: Array, form: BlockFormat, scratch: Scratch) -> BlockParameters:
    """Round to nearest, with the range factor of ``RANGE_FACTORS`` and the scale of least error for each block.

    For given codes the best scale is a quotient of two sums, and so is its gain; the codes with the largest gain win.
    """
    spanned, low = _block_ranges(planes, form)
    best = BlockParameters(spanned, low)
    gained = np.full_like(spanned, -np.inf)
    for factor in RANGE_FACTORS:
        scale = spanned * np.float32(factor)
        zero = _zero_points(scale, low, form)
        along, power = _scale_terms(planes, encode(planes, BlockParameters(scale, zero), form, scratch))
        fitted = along / power
        gain = along * fitted
        better = gain > gained
        best = BlockParameters(np.where(better, fitted, best.scale), np.where(better, zero, best.zero))
        np.maximum(gained, gain, out=gained)
    flat = np.abs(best.scale) < NEGLIGIBLE_RANGE
    return BlockParameters(np.where(flat, spanned, best.scale), best.zero) if flat.any() else best


def half_quadratic_parameters(planes: Array, form: BlockFormat, scratch: Scratch) -> BlockParameters:
    """Choose the zero point of least error in an Lp norm, p < 1, robust to outliers (HQQ, Badri and Shaji 2023).

    The zero point is rounded to an integer, as the integer kernels require, and the scale fitted to it.
    """
    scale, zero = range_parameters(planes, form, scratch)
    beta = HQQ_BETA
    error: Array
    for _ in range(0 if form.symmetric else HQQ_ROUNDS):
        codes = np.clip(np.rint(planes / scale + zero), 0, form.levels)
        error = planes - (codes - zero) * scale
        size = np.abs(error)
        shrunk = np.sign(error) * np.maximum(size - np.power(size + 1e-12, HQQ_NORM - 1) / np.float32(beta), 0)
        zero = np.add.reduce(codes - (planes - shrunk) / scale, axis=0) / np.float32(form.block)
        beta *= HQQ_GROWTH
    zero = np.clip(np.rint(zero), 0, form.levels)
    along, power = _scale_terms(planes, encode(planes, BlockParameters(scale, zero), form, scratch))
    fitted = along / power
    usable = np.isfinite(fitted) & (np.abs(fitted) > NEGLIGIBLE_RANGE)
    return BlockParameters(np.where(usable, fitted, scale).astype(np.float32), zero)


def _scale_terms(planes: Array, codes: Array) -> tuple[Array, Array]:
    """Return weights times codes and codes times codes (at least 1) of each block: their ratio is the best scale."""
    along = np.einsum("ij,ij->j", planes, codes)
    return along, np.maximum(np.einsum("ij,ij->j", codes, codes), np.float32(1))


def encode(planes: Array, parameters: BlockParameters, form: BlockFormat, scratch: Scratch) -> Array:
    """Return codes minus zero point, (block, n) integers in float32, valid until the next call."""
    codes = scratch("codes", planes.shape)
    np.multiply(planes, np.float32(1) / parameters.scale, out=codes)
    np.maximum(codes, -parameters.zero, out=codes)
    np.minimum(codes, np.float32(form.levels) - parameters.zero, out=codes)
    return np.rint(codes, out=codes)


def pack(codes: Array, zero: Array, form: BlockFormat, scratch: Scratch, out: Array) -> None:
    """Pack codes minus zero point, (block, n), as (n, bytes) uint8 into ``out``, which may be strided."""
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


def unpack(stored: Array, form: BlockFormat, scratch: Scratch) -> Array:
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
    planes: Array, form: BlockFormat, choose: ParameterChoice, scratch: Scratch, out: Array | None = None
) -> QuantizedBlocks:
    """Quantize planes and measure the error of the stored codes.

    Args:
        planes: (block, n) float32.
        choose: Method that finds scale and zero point.
        out: (n, bytes) uint8 for the codes, may be strided.

    Returns:
        The blocks; ``squared_norm`` is not finite when a weight is not.
    """
    norm = float(np.vdot(planes, planes))
    codes = np.empty((planes.shape[1], form.code_bytes), np.uint8) if out is None else out
    if not np.isfinite(norm):
        wide = planes.astype(np.float64)
        norm = float(np.vdot(wide, wide))
    if not np.isfinite(norm):
        return QuantizedBlocks(codes, planes[0], planes[0], norm, norm)
    parameters = choose(planes, form, scratch)
    pack(encode(planes, parameters, form, scratch), parameters.zero, form, scratch, codes)
    lost = squared_error(planes, codes, parameters, form, scratch)
    return QuantizedBlocks(codes, parameters.scale, parameters.zero.astype(np.uint8), lost, norm)


def squared_error(
    planes: Array, stored: Array, parameters: BlockParameters, form: BlockFormat, scratch: Scratch
) -> float:
    """Return the sum of squared differences between planes and dequantized codes."""
    restored = scratch("codes", planes.shape)
    np.subtract(unpack(stored, form, scratch), parameters.zero, out=restored)
    np.multiply(restored, parameters.scale, out=restored)
    np.subtract(restored, planes, out=restored)
    return float(np.vdot(restored, restored))


def pack_zero_points(zero: Array, form: BlockFormat) -> Array:
    """Pack zero points (rows, blocks) uint8 in ONNX Runtime's format: (rows, ceil(blocks * bits / 8)) uint8."""
    return zero if form.bits == 8 else pack_nibbles(zero)


def unpack_zero_points(packed: Array, count: int, form: BlockFormat) -> Array:
    """Undo ``pack_zero_points``: (rows, count) uint8."""
    return packed if form.bits == 8 else unpack_nibbles(packed, count)


def pack_nibbles(codes: Array) -> Array:
    """Pack the low halves of bytes in pairs along the last axis, the first one low; an odd number ends in zero."""
    packed: Array = codes[..., 0::2] & 15
    packed[..., : codes.shape[-1] // 2] |= codes[..., 1::2] << 4
    return packed


def unpack_nibbles(packed: Array, count: int) -> Array:
    """Undo ``pack_nibbles``: (..., count)."""
    return np.stack([packed & 15, packed >> 4], axis=-1).reshape(*packed.shape[:-1], -1)[..., :count]


def dequantize(stored: Array, scale: Array, zero: Array, form: BlockFormat) -> Array:
    """Return dequantized blocks (n, block) float32, in their natural order."""
    planes: Array = unpack(stored, form, Scratch()).astype(np.float32)
    planes = (planes - zero.astype(np.float32)) * scale
    half = form.block // 2
    natural = np.empty((planes.shape[1], form.block), np.float32)
    natural[:, 0::2], natural[:, 1::2] = planes[:half].T, planes[half:].T
    return natural


METHODS: dict[str, ParameterChoice] = {
    "rtn": range_parameters, "searched": searched_parameters, "hqq": half_quadratic_parameters
}  # fmt: skip
