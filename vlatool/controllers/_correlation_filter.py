"""A correlation filter that follows a patch of an image from frame to frame, in NumPy.

The filter is the minimum output sum of squared error of Bolme et al., "Visual object tracking using adaptive
correlation filters" (CVPR 2010): its response to the patch is a Gaussian at the centre of the target, and the place of
the peak in the next frame is the motion. The peak-to-sidelobe ratio says whether the target is still there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
SIDE = 64
"""Pixels along one side of the patch that is compared, whatever the size of the target."""
CONTEXT = 2.0
"""Size of the patch, in sizes of the target: it can move by about half of its size from frame to frame."""
LEARNING_RATE = 0.125
"""Share of a new frame in the filter, as in the paper."""
SPREAD = 2.0
"""Standard deviation of the response that is asked for, in pixels of the patch, as in the paper."""
REGULARISATION = 0.01
"""Added to the power of each frequency; patches have unit variance."""
SIDELOBE = 5
"""Half of the window around the peak that does not count as sidelobe, in pixels of the patch: 11 x 11 in the paper."""
MIN_RATIO = 6.0
"""Peak-to-sidelobe ratio below which the target is lost; the paper sees 20 to 60 while it tracks, and 7 at its loss."""

_AXIS = np.arange(SIDE) - SIDE // 2
_WINDOW = np.outer(np.hanning(SIDE), np.hanning(SIDE))
_TARGET = np.fft.rfft2(np.exp(-(_AXIS[:, None] ** 2 + _AXIS[None, :] ** 2) / (2.0 * SPREAD**2)))


class Box(NamedTuple):
    """A rectangle of an image, in pixels: its centre and its size."""

    x: float
    y: float
    width: float
    height: float


class CorrelationFilter(NamedTuple):
    """A filter and where its target was last.

    Args:
        box: The target in the last frame in which it was found.
        numerator: (64, 33) complex128.
        denominator: (64, 33) float64.
    """

    box: Box
    numerator: Array
    denominator: Array


def begin(image: Array, box: Box) -> CorrelationFilter:
    """Return the filter of a target, in one frame: (H, W) or (H, W, C), of any dtype."""
    spectrum = _spectrum(image, box)
    return CorrelationFilter(box, _TARGET * spectrum.conj(), (spectrum * spectrum.conj()).real)


def follow(image: Array, known: CorrelationFilter) -> tuple[CorrelationFilter, bool]:
    """Return the filter after a frame, and whether the target was found in it; a lost target leaves it as it was."""
    spectrum = _spectrum(image, known.box)
    response = np.fft.irfft2(spectrum * known.numerator / (known.denominator + REGULARISATION * SIDE**2), (SIDE, SIDE))
    row, column = np.unravel_index(int(response.argmax()), response.shape)
    if not _ratio(response, int(row), int(column)) >= MIN_RATIO:
        return known, False
    box = known.box
    x = box.x + _AXIS[column] * box.width * CONTEXT / SIDE
    y = box.y + _AXIS[row] * box.height * CONTEXT / SIDE
    if not (0 <= x < image.shape[1] and 0 <= y < image.shape[0]):
        return known, False
    box = box._replace(x=float(x), y=float(y))
    spectrum, rate = _spectrum(image, box), LEARNING_RATE
    numerator = rate * _TARGET * spectrum.conj() + (1.0 - rate) * known.numerator
    denominator = rate * (spectrum * spectrum.conj()).real + (1.0 - rate) * known.denominator
    return CorrelationFilter(box, numerator, denominator), True


def _spectrum(image: Array, box: Box) -> Array:
    """Return the transform of the patch around a box, with zero mean and unit variance, below a cosine window."""
    rows = np.clip(np.rint(box.y + _AXIS * box.height * CONTEXT / SIDE), 0, image.shape[0] - 1).astype(int)
    columns = np.clip(np.rint(box.x + _AXIS * box.width * CONTEXT / SIDE), 0, image.shape[1] - 1).astype(int)
    patch = image[rows[:, None], columns]
    patch = np.log1p(patch.sum(axis=2, dtype=np.float64) if patch.ndim == 3 else patch)
    patch = (patch - patch.mean()) / (patch.std() + 1e-5)
    return np.fft.rfft2(patch * _WINDOW)


def _ratio(response: Array, row: int, column: int) -> float:
    """Return how far the peak stands above the rest, in standard deviations of the rest."""
    rest = np.ones(response.shape, bool)
    rest[max(row - SIDELOBE, 0) : row + SIDELOBE + 1, max(column - SIDELOBE, 0) : column + SIDELOBE + 1] = False
    sidelobe = response[rest]
    return float((response[row, column] - sidelobe.mean()) / (sidelobe.std() + 1e-12))
