"""Activation-aware rounding of one weight at a time: GPTQ and AWQ."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from vlatool.quantize.streamed._block_quantization import (
    BlockFormat,
    BlockParameters,
    ParameterChoice,
    Scratch,
    dequantize,
    quantize_planes,
)
from vlatool.runtime.interface import Array

DAMPING = 0.01
AWQ_EXPONENTS = tuple(step / 10 for step in range(11))
SEARCH_ROWS = 512
"""Rows of activations on which AWQ compares its scales."""


class RoundedWeight(NamedTuple):
    """One quantized weight.

    Args:
        codes: (columns, blocks, bytes) uint8.
        scale: (columns, blocks) float32.
        zero: (columns, blocks) uint8.
        restored: (columns, rows) float32, the effective weight of the layer.
        input_scale: (rows,) float32 factors of the activations, None without.
    """

    codes: Array
    scale: Array
    zero: Array
    restored: Array
    input_scale: Array | None = None


def round_to_nearest(weight: Array, form: BlockFormat, choose: ParameterChoice) -> RoundedWeight:
    """Round a weight (columns, rows) float32 to nearest."""
    columns, rows = weight.shape
    count = -(-rows // form.block)
    codes = np.empty((columns, count, form.code_bytes), np.uint8)
    scale, zero = np.empty((columns, count), np.float32), np.empty((columns, count), np.uint8)
    restored = np.empty((columns, count * form.block), np.float32)
    scratch = Scratch()
    for number in range(count):
        quantized = quantize_planes(_planes(weight, number, form), form, choose, scratch, codes[:, number])
        scale[:, number], zero[:, number] = quantized.scale, quantized.zero
        begin = number * form.block
        restored[:, begin : begin + form.block] = dequantize(codes[:, number], quantized.scale, quantized.zero, form)
    return RoundedWeight(codes, scale, zero, np.ascontiguousarray(restored[:, :rows]))


def _planes(weight: Array, number: int, form: BlockFormat) -> Array:
    """Return one block of every column as planes, padded with zeros at the end of the rows."""
    part = weight[:, number * form.block : (number + 1) * form.block]
    if part.shape[1] < form.block:
        part = np.pad(part, ((0, 0), (0, form.block - part.shape[1])))
    return np.ascontiguousarray(np.concatenate([part[:, 0::2].T, part[:, 1::2].T]), np.float32)


def gptq(weight: Array, activations: Array, form: BlockFormat, choose: ParameterChoice) -> RoundedWeight:
    """Round one input after the other and compensate its error in the inputs that follow (Frantar et al. 2022).

    Args:
        weight: (columns, rows) float32.
        activations: (samples, rows) float32.

    Returns:
        The weight; scales and zero points of a block are chosen after the compensation of earlier blocks.

    Raises:
        LinAlgError: when the activations are too large or too similar for the method.
    """
    import torch

    weights = torch.from_numpy(weight.copy())
    upper = _inverse_factor(torch, activations)
    rounded = np.empty_like(weight)
    parameters: list[BlockParameters] = []
    for number in range(-(-weight.shape[1] // form.block)):
        begin, end = number * form.block, min((number + 1) * form.block, weight.shape[1])
        parameters.append(choose(_planes(weights.numpy(), number, form), form, Scratch()))
        part = np.ascontiguousarray(weights[:, begin:end].numpy().T)
        lost = _round_block(part, upper[begin:end, begin:end].numpy(), parameters[-1], form)
        rounded[:, begin:end] = part.T
        weights[:, end:] -= torch.from_numpy(lost).T @ upper[begin:end, end:]
    remaining = iter(parameters)

    def fixed_parameters(_planes: Array, _form: BlockFormat, _scratch: Scratch) -> BlockParameters:
        return next(remaining)

    return round_to_nearest(rounded, form, fixed_parameters)


def _round_block(part: Array, factor: Array, parameters: BlockParameters, form: BlockFormat) -> Array:
    """Round the inputs of one block in turn, in place; return the error of each, for the blocks that follow.

    Args:
        part: (inputs, columns) float32; single-threaded numpy, since these are many short operations.
        factor: (inputs, inputs) block of the Cholesky factor.
    """
    lost = np.empty_like(part)
    for index in range(len(part)):
        codes = np.clip(np.rint(part[index] / parameters.scale), -parameters.zero, form.levels - parameters.zero)
        rounded = codes * parameters.scale
        lost[index] = (part[index] - rounded) / factor[index, index]
        part[index] = rounded
        part[index + 1 :] -= np.outer(factor[index, index + 1 :], lost[index])
    return lost


def _inverse_factor(torch: Any, activations: Array) -> Any:
    """Return the upper Cholesky factor of the inverse of the damped second moment of the activations, (rows, rows).

    Inputs that are never active neither receive nor cause compensation.
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


def awq(weight: Array, activations: Array, form: BlockFormat, choose: ParameterChoice) -> RoundedWeight:
    """Scale up the weights of inputs with large activations before rounding (Lin et al. 2023).

    The exponent of the mean magnitude is the one of ``AWQ_EXPONENTS`` with the least error of the product.
    """
    magnitude = np.maximum(np.mean(np.abs(activations), axis=0, dtype=np.float64), 1e-6)
    step = max(1, len(activations) // SEARCH_ROWS)
    rows = activations[::step][:SEARCH_ROWS]
    best, least = _round_scaled(weight, magnitude ** AWQ_EXPONENTS[0], rows, form, choose)
    for exponent in AWQ_EXPONENTS[1:]:
        rounded, lost = _round_scaled(weight, magnitude**exponent, rows, form, choose)
        if lost < least:
            best, least = rounded, lost
    return best


def _round_scaled(
    weight: Array, factors: Array, rows: Array, form: BlockFormat, choose: ParameterChoice
) -> tuple[RoundedWeight, float]:
    """Return the weight rounded after scaling its inputs by factors, and the norm of the error of the product."""
    factors = (factors / np.sqrt(factors.max() * factors.min())).astype(np.float32)
    rounded = round_to_nearest(weight * factors, form, choose)
    restored = rounded.restored / factors
    lost = float(np.linalg.norm(rows @ (restored - weight).T))
    return rounded._replace(restored=restored, input_scale=np.float32(1) / factors), lost
