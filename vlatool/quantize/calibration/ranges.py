"""Ranges of activations from streamed statistics."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.interface import Array

Method = Literal["minmax", "percentile", "entropy", "mse"]

BINS = 4096
"""Bins of a histogram over [-radius, radius)."""
MAX_SAMPLED_ELEMENTS = 1 << 16
"""Elements of one tensor of one sample that enter its histogram, at an even stride; the extremes cover all elements."""
LEVELS = 256
MAX_CLIPPED_ENERGY = 1e-3
"""Share of the squared values that ``entropy`` may clip: divergence alone would sacrifice rare large values, such as
the peaks of a softmax, for many small ones."""


@dataclass
class Statistics:
    """Extremes and a histogram of one activation, in constant memory.

    The histogram covers [-radius, radius) with the radius a power of two. A value outside doubles the radius and merges
    bins in pairs, so one pass is enough and the order of the samples does not matter beyond the choice of elements.

    Args:
        channels: Whether the largest magnitude of each entry of the last axis is collected, too.
        finite: False once a value was NaN or infinite where that is allowed: then the activation has no range.
    """

    channels: bool = False
    low: float = 0.0
    high: float = 0.0
    radius: float = 0.0
    samples: int = 0
    zeros: int = 0
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))
    peaks: Array | None = None
    finite: bool = True

    def add(self, values: Array) -> None:
        """Add one tensor of any shape, finite float."""
        flat = values.reshape(-1)
        if not flat.size:
            return
        low, high = float(flat.min()), float(flat.max())
        self.low, self.high = (min(self.low, low), max(self.high, high)) if self.samples else (low, high)
        self.samples += 1
        if self.channels:
            peaks = np.abs(values.reshape(-1, values.shape[-1])).max(0)
            self.peaks = peaks if self.peaks is None else np.maximum(self.peaks, peaks)
        largest = max(abs(low), abs(high))
        if largest > 0:
            self._grow(largest)
        sampled = flat[:: _stride(flat.size)]
        self.zeros += len(sampled) - int(np.count_nonzero(sampled))
        if not self.radius:  # zeros alone so far; their bin is the same at every radius
            self.counts[BINS // 2] += len(sampled)
            return
        bins = ((sampled.astype(np.float64) + self.radius) * (BINS / (2 * self.radius))).astype(np.int64)
        self.counts += np.bincount(np.clip(bins, 0, BINS - 1), minlength=BINS)

    def _grow(self, largest: float) -> None:
        radius = 2.0 ** math.frexp(largest)[1]
        if not self.radius:
            self.radius = radius
        while self.radius < radius:
            merged = self.counts.reshape(-1, 2).sum(1)
            self.counts = np.zeros(BINS, np.int64)
            self.counts[BINS // 4 : BINS // 4 + BINS // 2] = merged
            self.radius *= 2

    def centres(self) -> NDArray[np.float64]:
        """Return the centres of the bins."""
        width = 2 * self.radius / BINS
        return (np.arange(BINS, dtype=np.float64) + 0.5) * width - self.radius


def _stride(size: int) -> int:
    """Return a stride that leaves at most ``MAX_SAMPLED_ELEMENTS`` elements and meets every index of every axis.

    A stride that shares a factor with the number of channels would see the same few channels in every row.
    """
    stride = max(1, -(-size // MAX_SAMPLED_ELEMENTS))
    while math.gcd(stride, size) > 1:
        stride += 1
    return stride


def choose_range(
    statistics: Statistics, method: Method, percentile: float, symmetric: bool, unsigned: bool = False
) -> tuple[float, float]:
    """Return (low, high) that an activation is quantized over.

    Args:
        method: ``minmax``: the extremes. ``percentile``: the central share of the values. ``entropy``: the clipping
            with the least Kullback-Leibler divergence (Migacz, 8-bit Inference with TensorRT, GTC 2017). ``mse``: the
            clipping with the least expected squared error.
        percentile: Share in percent, for ``percentile``.
        symmetric: Whether the range is mirrored at zero.
        unsigned: Whether a range that is never negative stays one-sided, even when symmetric.
    """
    low, high = statistics.low, statistics.high
    symmetric = symmetric and not (unsigned and low >= 0)
    if method == "percentile":
        low, high = _percentile(statistics, percentile)
    elif method == "entropy":
        threshold = _entropy(statistics)
        low, high = max(low, -threshold), min(high, threshold)
    elif method == "mse":
        low, high = _least_squares(statistics, symmetric)
    low, high = min(low, 0.0), max(high, 0.0)
    if symmetric:
        high = max(-low, high)
        low = -high
    return low, high


def _percentile(statistics: Statistics, percentile: float) -> tuple[float, float]:
    shares = np.cumsum(statistics.counts) / max(1, int(statistics.counts.sum()))
    tail = (1 - percentile / 100) / 2
    centres, half = statistics.centres(), statistics.radius / BINS
    low = float(centres[min(BINS - 1, int(np.searchsorted(shares, tail, side="right")))]) - half
    high = float(centres[min(BINS - 1, int(np.searchsorted(shares, 1 - tail)))]) + half
    return max(low, statistics.low), min(high, statistics.high)


def _least_squares(statistics: Statistics, symmetric: bool) -> tuple[float, float]:
    """Search both ends of the range, one after the other, for the least expected squared error."""
    centres, weights = statistics.centres(), statistics.counts.astype(np.float64)
    rounded = weights.copy()
    rounded[BINS // 2] -= statistics.zeros  # zero is a level of every range: it is never rounded
    used = weights > 0
    centres, weights, rounded = centres[used], weights[used], rounded[used]
    low, high = min(statistics.low, 0.0), max(statistics.high, 0.0)
    if high <= low or not len(centres):
        return low, high

    def cost(first: float, last: float) -> float:
        if last <= first:
            return math.inf
        step = (last - first) / (LEVELS - 1)
        excess = np.maximum(centres - last, 0) + np.maximum(first - centres, 0)
        inside = np.where(excess > 0, 0.0, step * step / 12)
        return float(weights @ (excess * excess) + rounded @ inside)

    shrinks = np.linspace(1.0, 0.2, 81)
    if symmetric:
        radius = max(-low, high)
        for _ in range(3):
            best = float(min(shrinks, key=lambda share: cost(-radius * share, radius * share)))
            radius *= best
            if best > shrinks[-1]:
                break
        return -radius, radius
    for _ in range(3):
        top = min(shrinks, key=lambda share: cost(low, high * share))
        high *= float(top)
        bottom = min(shrinks, key=lambda share: cost(low * share, high))
        low *= float(bottom)
        if top == bottom == 1.0:
            break
    return low, high


def _entropy(statistics: Statistics) -> float:
    """Return the threshold on magnitudes whose 128-level quantization loses the least information."""
    half = BINS // 2
    counts = _side_counts(statistics.counts[half:]) + _side_counts(statistics.counts[:half][::-1])
    last = int(np.nonzero(counts)[0][-1]) + 1 if counts.any() else 0
    levels = LEVELS // 2
    if last <= levels:
        return max(-statistics.low, statistics.high)
    best, best_stop = math.inf, last
    for stop in range(_first_stop(counts, levels), last + 1, 8):
        loss = _divergence(counts, stop, levels)
        if loss < best:
            best, best_stop = loss, stop
    width = statistics.radius / half
    return min(best_stop * width, max(-statistics.low, statistics.high))


def _side_counts(side: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return counts of magnitudes, the first bin limited to the second.

    Zero is a level of every range, so the zeros of a ReLU or a mask are exact in any of them; their number would still
    dominate the divergence. TensorRT's calibrator ignores the first bin, too.
    """
    counts = side.astype(np.float64)
    counts[0] = min(counts[:2])
    return counts


def _first_stop(counts: NDArray[np.float64], levels: int) -> int:
    """Return the first bin, from ``levels``, with at most ``MAX_CLIPPED_ENERGY`` of the squared magnitudes above it."""
    energy = counts * (np.arange(len(counts)) + 0.5) ** 2
    beyond = energy.sum() - np.cumsum(energy)
    return max(levels, int(np.argmax(beyond <= MAX_CLIPPED_ENERGY * energy.sum())) + 1)


def _divergence(counts: NDArray[np.float64], stop: int, levels: int) -> float:
    """Return KL(clipped || quantized) of magnitudes below bin ``stop``."""
    kept = counts[:stop].copy()
    clipped = kept.copy()
    clipped[-1] += counts[stop:].sum()
    group = np.arange(stop) * levels // stop
    sums = np.bincount(group, weights=kept, minlength=levels)
    filled = np.bincount(group, weights=(kept > 0).astype(np.float64), minlength=levels)
    share = np.divide(sums, filled, out=np.zeros(levels), where=filled > 0)
    quantized = np.where(kept > 0, share[group], 0.0)
    total, rounded = clipped.sum(), quantized.sum()
    if total <= 0 or rounded <= 0:
        return math.inf
    p, q = clipped / total, quantized / rounded
    nonzero = p > 0
    return float(np.sum(p[nonzero] * np.log(p[nonzero] / np.maximum(q[nonzero], 1e-12))))
