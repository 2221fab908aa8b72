"""Thousands of raw samples as a few points that keep their shape: quantiles, a histogram, an envelope."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from vlatool.measures import series
from vlatool.measures.latency import LATENCY
from vlatool.render.charts.svg import with_colours
from vlatool.report import Report, Row

MAX_VARIANTS = 8
MARKED_PERCENTILES = {"p50": 0.5, "p90": 0.9, "p99": 0.99}
"""The percentiles that are marked on the curve and below the histogram."""


def finite(samples: Sequence[float | None]) -> list[float]:
    """Return the samples that are numbers (a NaN is null in JSON)."""
    return [float(sample) for sample in samples if sample is not None and math.isfinite(sample)]


def quantile(ordered: Sequence[float], share: float) -> float:
    """Return the smallest sample that at least that share of the samples does not exceed."""
    return ordered[max(0, math.ceil(share * len(ordered) - 1e-9) - 1)]


def ecdf(ordered: Sequence[float], points: int = 120) -> list[tuple[float, float]]:
    """Return (sample, share of samples that are not larger), at most about ``points`` of them, the tail kept finer."""
    size = len(ordered)
    if size <= points:
        return [(sample, (index + 1) / size) for index, sample in enumerate(ordered)]
    shares = sorted({*(index / points for index in range(1, points)), 0.995, 0.999, 1.0})
    return [(ordered[0], 1 / size), *((quantile(ordered, share), share) for share in shares)]


def histogram(samples: Sequence[float], position_of: Callable[[float], float], bins: int) -> list[int]:
    """Count samples in equal bins of ``place(sample)``, which is 0-1 inside; those outside are not counted."""
    counts = [0] * bins
    for sample in samples:
        position = position_of(sample)
        if 0 <= position <= 1:
            counts[min(bins - 1, int(position * bins))] += 1
    return counts


@dataclass(frozen=True)
class Band:
    """The samples of a stretch of time.

    Args:
        at: The middle of the stretch.
        low, high: The smallest and the largest sample.
        lower, upper: The 10th and the 90th percentile.
        middle: The median.
    """

    at: float
    low: float
    lower: float
    middle: float
    upper: float
    high: float


def envelope(times: Sequence[float], samples: Sequence[float], bins: int) -> list[Band]:
    """Return a band for each of ``bins`` equal stretches of time that has samples; ``times`` ascend."""
    first, last = times[0], times[-1]
    wide = (last - first) / bins
    stretches: list[list[float]] = [[] for _ in range(bins)]
    for moment, sample in zip(times, samples, strict=True):
        stretches[min(bins - 1, int((moment - first) / wide)) if wide > 0 else 0].append(sample)
    bands = []
    for index, part in enumerate(stretches):
        if part:
            part.sort()
            inner = quantile(part, 0.1), statistics.median(part), quantile(part, 0.9)
            bands.append(Band(first + (index + 0.5) * wide, part[0], *inner, part[-1]))
    return bands


def sparkline(samples: Sequence[float], bins: int) -> str:
    """Return a histogram of one line of text, from the smallest sample to the 99th percentile; blanks do not break."""
    ordered = sorted(samples)
    low, high = ordered[0], quantile(ordered, 0.99)
    if high <= low:
        return "█"
    counts = histogram(ordered, lambda sample: (sample - low) / (high - low), bins)
    peak = max(counts)
    return "".join("\xa0▁▂▃▄▅▆▇█"[math.ceil(8 * count / peak)] for count in counts)


@dataclass(frozen=True)
class Sampled:
    """The latency samples of one variant.

    Args:
        name, css: The variant and the class of its colour.
        samples: Latencies in ms, as they came.
        ordered: The same, ascending.
        known: Share -> the percentile that the report has.
        times: When each call began, in seconds since the start of the run; empty when that is not known.
    """

    name: str
    css: str
    samples: list[float]
    ordered: list[float]
    known: Mapping[float, float]
    times: list[float]

    @property
    def marks(self) -> dict[str, float]:
        """The percentiles that are marked, name -> share: those that the report has, all where it has none."""
        return {name: share for name, share in MARKED_PERCENTILES.items() if share in self.known or not self.known}

    def at(self, share: float) -> float:
        """Return a quantile in ms; the reported one where the report has it."""
        return self.known.get(share) or quantile(self.ordered, share)


def left_out(report: Report) -> str:
    """Return a sentence about the variants for which the charts have no room."""
    more = sum(len(finite(row.raw.get(series.LATENCY) or [])) > 1 for row in report.rows) - MAX_VARIANTS
    return f"Only the first {MAX_VARIANTS} variants are drawn; {more} more in the tables." if more > 0 else ""


def sampled_variants(report: Report) -> list[Sampled]:
    """Return the variants that kept latency samples, the first eight at most."""
    variants: list[Sampled] = []
    for row, css in with_colours(report.rows):
        samples, times = _timed(row)
        if len(samples) > 1 and len(variants) < MAX_VARIANTS:
            reported = {share: row.value(LATENCY.quantity(name)) for name, share in MARKED_PERCENTILES.items()}
            known = {share: value for share, value in reported.items() if math.isfinite(value)}
            variants.append(Sampled(row.name, css, samples, sorted(samples), known, times))
    return variants


def _timed(row: Row) -> tuple[list[float], list[float]]:
    """Return the samples, and when each call began; no times unless all are known and time went on."""
    samples, times = row.raw.get(series.LATENCY) or [], row.raw.get(series.START_TIMES) or []
    if len(times) != len(samples):
        return finite(samples), []
    kept = [time for time, sample in zip(times, samples, strict=True) if finite([sample])]
    known = finite(kept)
    going = len(known) == len(kept) > 1 and 0 <= known[0] < known[-1] and all(a <= b for a, b in pairwise(known))
    return finite(samples), known if going else []
