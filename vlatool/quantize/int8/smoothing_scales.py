"""The scales of SmoothQuant (Xiao et al., SmoothQuant, ICML 2023, arXiv 2211.10438) and the int8 loss with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vlatool.runtime.interface import Array

MIN_PEAK_SHARE = 1e-4
"""Smallest peak of a channel, as a share of the largest one: bounds the scale of a channel without calibration data."""
CREST_FACTOR = 4.0
"""Assumed ratio of peak to root mean square of an activation channel of which only the peak is known."""
ALPHAS = tuple(step / 10 for step in range(11))


def weight_peaks(weights: Sequence[Array]) -> Array:
    """Return the largest magnitude of each input channel over all weights, each (inputs, outputs)."""
    peaks: Array = np.maximum.reduce([np.abs(weight).max(1) for weight in weights])
    return peaks


def smooth_scales(activation: Array, weight: Array, alpha: float) -> Array:
    """Return ``s_j = max|X_j| ^ alpha / max|W_j| ^ (1 - alpha)`` (equation 4 of the paper) over its geometric mean.

    A common factor has no effect: the int8 scales of activations and of output channels compensate it.

    Args:
        activation: (inputs,) largest magnitude of each channel.
        weight: (inputs,) the same of the weights.
        alpha: 0 levels the weights, 1 the activations.
    """
    if not activation.max() > 0 or not weight.max() > 0:
        return np.ones(len(activation), np.float32)
    x = np.maximum(activation.astype(np.float64), activation.max() * MIN_PEAK_SHARE)
    w = np.maximum(weight.astype(np.float64), weight.max() * MIN_PEAK_SHARE)
    logarithm = alpha * np.log(x) - (1 - alpha) * np.log(w)
    scales: Array = np.exp(logarithm - logarithm.mean()).astype(np.float32)
    return scales


@dataclass(frozen=True)
class PeakExcess:
    """How far new observations are assumed to exceed the peaks of the calibration.

    A scale that levels all channels leaves none of them headroom: all clip where otherwise only the largest would.

    Args:
        spread: Share of its peak by which a channel exceeds it.
        share: Share of the values that do.
    """

    spread: float = 0.0
    share: float = 0.0

    @classmethod
    def between(cls, first: Array, second: Array, samples: int) -> PeakExcess:
        """Estimate from the peaks of two halves of the calibration: their median ratio, once in half the samples."""
        low, high = np.minimum(first, second), np.maximum(first, second)
        used = low > 0
        spread = float(np.median(high[used] / low[used])) - 1 if used.any() else 0.0
        return cls(spread, 2 / max(samples, 2))


NO_EXCESS = PeakExcess()


def int8_loss(activation: Array, weights: Sequence[Array], scales: Array, excess: PeakExcess = NO_EXCESS) -> float:
    """Estimate the squared error of ``X W`` when both are rounded to int8, from the peaks alone.

    Rounding to steps d adds noise of variance d^2 / 12. The activation has one step for all channels,
    ``2 max_j(X_j / s_j) / 255``, and its noise reaches the outputs through the weights; the weights have one step for
    each output channel, ``max_j |W_jo| s_j / 127``, and their noise is multiplied by the activation, whose mean square
    is assumed to be ``(X_j / (CREST_FACTOR s_j))^2``. Values beyond the range are clipped: ``(1 + spread) X_j / s_j``
    to ``max_j(X_j / s_j)``, in ``share`` of the values.
    """
    smooth = activation.astype(np.float64) / scales
    step = 2 * smooth.max() / 255
    energy = float(np.square(smooth / CREST_FACTOR).sum())
    lost = excess.share * np.square(np.maximum((1 + excess.spread) * smooth - smooth.max(), 0))
    loss = 0.0
    for weight in weights:
        scaled = weight.astype(np.float64) * scales[:, None].astype(np.float64)
        steps = np.abs(scaled).max(0) / 127
        through = np.square(scaled).sum(1)
        loss += float((step**2 / 12 + lost) @ through + energy * np.square(steps).sum() / 12)
    return loss


def best_alpha(
    activation: Array, weights: Sequence[Array], excess: PeakExcess = NO_EXCESS
) -> tuple[float | None, Array]:
    """Return the alpha of the grid with the least ``int8_loss`` and its scales; None and ones when none gains."""
    peaks = weight_peaks(weights)
    scales: Array = np.ones(len(activation), np.float32)
    chosen, least = None, int8_loss(activation, weights, scales, excess)
    for alpha in ALPHAS:
        candidate = smooth_scales(activation, peaks, alpha)
        loss = int8_loss(activation, weights, candidate, excess)
        if loss < least:
            chosen, least, scales = alpha, loss, candidate
    return chosen, scales
