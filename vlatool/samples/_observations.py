"""Example observations for a spec: smooth images, instructions, gaussian numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.samples._words import instructions

GRIDS = ((3, 60.0), (8, 35.0), (28, 15.0))  # cells across the image, amplitude in grey levels
Ranges = Mapping[str, tuple[float, float]]


def observations(spec: PolicySpec, ranges: Ranges, count: int, random: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Draw raw observations.

    Args:
        spec: Inputs without free axes; pixels uint8, numbers float32, or text.
        ranges: Inputs that are uniform in a range; other numbers are standard normal.

    Returns:
        Input name -> (count, ...) in the place of the batch axis; text as unicode (count,).
    """
    return {tensor.name: _values(tensor, ranges.get(tensor.name), count, random) for tensor in spec.inputs}


def _values(
    tensor: TensorSpec, limits: tuple[float, float] | None, count: int, random: np.random.Generator
) -> NDArray[Any]:
    if tensor.kind == "text":
        return np.array(instructions(count, random))
    shape = tuple(int(axis) for axis in tensor.shape[1:])
    if tensor.dtype == "uint8":
        return np.stack([smooth_image(shape[0], shape[1], random) for _ in range(count)])
    if limits is not None:
        return random.uniform(*limits, (count, *shape)).astype(np.float32)
    return random.standard_normal((count, *shape), np.float32)


def smooth_image(height: int, width: int, random: np.random.Generator) -> NDArray[np.uint8]:
    """Return (height, width, 3) uint8: coarse to fine bilinear noise, whose spectrum falls as that of photographs."""
    image = np.full((height, width, 3), random.uniform(90, 165, 3))
    for cells, amplitude in GRIDS:
        grid = random.standard_normal((cells + 1, cells + 1, 3))
        rows, columns = _interpolation(height, cells), _interpolation(width, cells)
        image += amplitude * np.einsum("hi,ijc,wj->hwc", rows, grid, columns, optimize=True)
    pixels: NDArray[np.uint8] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return pixels


def _interpolation(length: int, cells: int) -> NDArray[np.float64]:
    """(length, cells + 1): weights of the grid points at each pixel."""
    positions = np.linspace(0, cells, length)[:, None]
    weights: NDArray[np.float64] = np.maximum(0.0, 1.0 - np.abs(positions - np.arange(cells + 1)))
    return weights
