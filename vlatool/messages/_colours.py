"""Colours of images that cameras send unconverted: Bayer mosaics and YUV 4:2:2."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
BAYER_PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
"""Colours of the pixels of a 2 x 2 cell, row by row."""
YUV_TO_RGB = np.array([[1.164, 0.0, 1.596], [1.164, -0.392, -0.813], [1.164, 2.017, 0.0]], np.float32)
"""ITU-R BT.601 in limited range: rows red, green, blue; columns of Y - 16, U - 128, V - 128."""


def rgb_of_yuv422(pixels: Array, luma: int) -> Array:
    """Return the colours, (H, W, 3) uint8, of two bytes for each pixel, (H, W, 2) uint8 with an even W.

    Args:
        pixels: Luma and chroma of each pixel; chroma is U in even columns, V in odd ones.
        luma: Which of the two bytes is luma.
    """
    chroma = pixels[:, :, 1 - luma].astype(np.float32) - 128
    bright = pixels[:, :, luma].astype(np.float32) - 16
    u, v = (np.repeat(chroma[:, start::2], 2, axis=1) for start in (0, 1))
    colours = np.stack([bright, u, v], axis=2) @ YUV_TO_RGB.T
    clipped: Array = np.clip(np.rint(colours), 0, 255).astype(np.uint8)
    return clipped


def demosaic(mosaic: Array, pattern: str) -> Array:
    """Return the colours, (H, W, 3) uint8, of a Bayer mosaic, (H, W) uint8, each interpolated from the nearest pixels.

    Args:
        mosaic: One colour for each pixel.
        pattern: Which, as in ``BAYER_PATTERNS``.
    """
    height, width = mosaic.shape
    known = np.zeros((height, width, 3), np.float32)
    weight = np.zeros((height, width, 3), np.float32)
    for index, colour in enumerate(pattern):
        cell = (slice(index // 2, None, 2), slice(index % 2, None, 2), "rgb".index(colour))
        known[cell] = mosaic[cell[:2]]
        weight[cell] = 1
    near, total = _near(known), _near(weight)
    filled = near / np.maximum(total, 1e-6)
    return np.rint(np.where(weight > 0, known, filled)).astype(np.uint8)


def _near(values: Array) -> Array:
    """Return sums over 3 x 3 neighbours, (H, W, C), with weights 1 in corners, 2 at sides, 4 in the middle."""
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)))
    rows = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    sums: Array = rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]
    return sums
