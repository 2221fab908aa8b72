"""Rounding that looks at activations: GPTQ and AWQ, for one weight at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.quantize.streamed._block_quantization import Choose, Chosen, Format, Scratch, dequantize, quantize_planes

Array = NDArray[Any]
DAMPING = 0.01
EXPONENTS = tuple(step / 10 for step in range(11))
SEARCH_ROWS = 512
"""Activations on which AWQ compares its scales."""


class Rounded(NamedTuple):
    """One quantized weight.

    Args:
        codes: (columns, blocks, bytes) uint8.
        scale: (columns, blocks) float32.
        zero: (columns, blocks) uint8.
        meant: (columns, rows) float32, what the codes mean to the activations of the layer.
        inputs: (rows,) float32 that the activations are multiplied with, None without.
    """

    codes: Array
    scale: Array
    zero: Array
    meant: Array
    inputs: Array | None = None


def nearest_codes(weight: Array, form: Format, choose: Choose) -> Rounded:
    """Round a weight (columns, rows) float32 to nearest."""
    columns, rows = weight.shape
    count = -(-rows // form.block)
    codes = np.empty((columns, count, form.bytes), np.uint8)
    scale, zero = np.empty((columns, count), np.float32), np.empty((columns, count), np.uint8)
    meant = np.empty((columns, count * form.block), np.float32)
    scratch = Scratch()
    for number in range(count):
        quantized = quantize_planes(_planes(weight, number, form), form, choose, scratch, codes[:, number])
        scale[:, number], zero[:, number] = quantized.scale, quantized.zero
        begin = number * form.block
        meant[:, begin : begin + form.block] = dequantize(codes[:, number], quantized.scale, quantized.zero, form)
    return Rounded(codes, scale, zero, np.ascontiguousarray(meant[:, :rows]))


def _planes(weight: Array, number: int, form: Format) -> Array:
    """Return one block of every column as planes, padded with zeros at the end of the rows."""
    part = weight[:, number * form.block : (number + 1) * form.block]
    if part.shape[1] < form.block:
        part = np.pad(part, ((0, 0), (0, form.block - part.shape[1])))
    return np.ascontiguousarray(np.concatenate([part[:, 0::2].T, part[:, 1::2].T]), np.float32)


def gptq(weight: Array, activations: Array, form: Format, choose: Choose) -> Rounded:
    """Round one input after the other and move what is lost to the inputs that follow (Frantar et al. 2022).

    Args:
        weight: (columns, rows) float32.
        activations: (samples, rows) float32.

    Returns:
        The weight; scales and zero points of a block are chosen when its turn comes.

    Raises:
        LinAlgError: when the activations are too large or too much alike for the method.
    """
    import torch

    left = torch.from_numpy(weight.copy())
    upper = _inverse_factor(torch, activations)
    settled = np.empty_like(weight)
    chosen: list[Chosen] = []
    for number in range(-(-weight.shape[1] // form.block)):
        begin, end = number * form.block, min((number + 1) * form.block, weight.shape[1])
        chosen.append(choose(_planes(left.numpy(), number, form), form, Scratch()))
        part = np.ascontiguousarray(left[:, begin:end].numpy().T)
        lost = _settle(part, upper[begin:end, begin:end].numpy(), chosen[-1], form)
        settled[:, begin:end] = part.T
        left[:, end:] -= torch.from_numpy(lost).T @ upper[begin:end, end:]
    fixed = iter(chosen)

    def settled_choice(_planes: Array, _form: Format, _scratch: Scratch) -> Chosen:
        return next(fixed)

    return nearest_codes(settled, form, settled_choice)


def _settle(part: Array, factor: Array, chosen: Chosen, form: Format) -> Array:
    """Round the inputs of one block in turn, in place; return what each lost, for the blocks that follow.

    Args:
        part: (inputs, columns) float32; single-threaded numpy, since these are many short operations.
        factor: (inputs, inputs), the block's part of the Cholesky factor.
    """
    lost = np.empty_like(part)
    for index in range(len(part)):
        codes = np.clip(np.rint(part[index] / chosen.scale), -chosen.zero, form.levels - chosen.zero)
        settled = codes * chosen.scale
        lost[index] = (part[index] - settled) / factor[index, index]
        part[index] = settled
        part[index + 1 :] -= np.outer(factor[index, index + 1 :], lost[index])
    return lost


def _inverse_factor(torch: Any, activations: Array) -> Any:
    """Return the upper Cholesky factor of the inverse of the damped second moment of the activations, (rows, rows).

    What an input that is never active loses is not moved to others, nor others' loss to it.
    """
    active = torch.from_numpy(activations)
    moment = active.T @ active
    diagonal = moment.diagonal()
    dead = diagonal == 0
    if dead.all():
        return torch.eye(len(moment))
    usual = diagonal[~dead].mean()
    diagonal[dead] = usual
    diagonal += DAMPING * usual
    factor = torch.linalg.cholesky(moment)
    del moment, diagonal
    inverse = torch.cholesky_inverse(factor)
    del factor
    return torch.linalg.cholesky(inverse, upper=True)


def awq(weight: Array, activations: Array, form: Format, choose: Choose) -> Rounded:
    """Enlarge the weights of inputs with large activations before rounding (Lin et al. 2023).

    The exponent of the mean magnitude is the one of ``EXPONENTS`` that loses least of the product.
    """
    magnitude = np.maximum(np.mean(np.abs(activations), axis=0, dtype=np.float64), 1e-6)
    step = max(1, len(activations) // SEARCH_ROWS)
    rows = activations[::step][:SEARCH_ROWS]
    best, least = _enlarged(weight, magnitude ** EXPONENTS[0], rows, form, choose)
    for exponent in EXPONENTS[1:]:
        rounded, lost = _enlarged(weight, magnitude**exponent, rows, form, choose)
        if lost < least:
            best, least = rounded, lost
    return best


def _enlarged(weight: Array, factors: Array, rows: Array, form: Format, choose: Choose) -> tuple[Rounded, float]:
    """Return the weight rounded after its inputs were multiplied by factors, and the norm of what the product loses."""
    factors = (factors / np.sqrt(factors.max() * factors.min())).astype(np.float32)
    rounded = nearest_codes(weight * factors, form, choose)
    meant = rounded.meant / factors
    lost = float(np.linalg.norm(rows @ (meant - weight).T))
    return rounded._replace(meant=meant, inputs=np.float32(1) / factors), lost
