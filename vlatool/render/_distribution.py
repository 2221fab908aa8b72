"""Chart: how the latencies of the variants are spread."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from vlatool.render._format import fixed, significant, tick
from vlatool.render._samples import ecdf, finite, histogram, quantile
from vlatool.render._svg import Axis, Canvas, axis_for, series, shorten
from vlatool.render._view import Latency
from vlatool.report import Report, Row

SERIES_NAME, TIMES = "latency_ms", "at_s"
MOST = 8
STRIP = 52
MARKED = {"p50": 0.5, "p90": 0.9, "p99": 0.99}
"""The percentiles that are marked on the curve and below the histogram."""


@dataclass(frozen=True)
class Sampled:
    """The latency samples of one variant.

    Args:
        name, css: The variant and the class of its colour.
        samples: In ms, as they came.
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
        return {name: share for name, share in MARKED.items() if share in self.known or not self.known}

    def at(self, share: float) -> float:
        """Return a quantile in ms; the reported one where the report has it."""
        return self.known.get(share) or quantile(self.ordered, share)


def left_out(report: Report) -> str:
    """Return a sentence about the variants for which the charts have no room."""
    more = sum(len(finite(row.raw.get(SERIES_NAME) or [])) > 1 for row in report.rows) - MOST
    return f"Only the first {MOST} variants are drawn; {more} more in the tables." if more > 0 else ""


def sampled(report: Report) -> list[Sampled]:
    """Return the variants that kept latency samples, the first eight at most."""
    found: list[Sampled] = []
    for row, css in zip(report.rows, series(report.rows), strict=True):
        samples, times = _series(row)
        if len(samples) > 1 and len(found) < MOST:
            reported = {share: row.value(f"latency_{name}") for name, share in MARKED.items()}
            known = {share: value for share, value in reported.items() if math.isfinite(value)}
            found.append(Sampled(row.name, css, samples, sorted(samples), known, times))
    return found


def _series(row: Row) -> tuple[list[float], list[float]]:
    """Return the samples, and when each call began; no times unless all are known and time went on."""
    samples, times = row.raw.get(SERIES_NAME) or [], row.raw.get(TIMES) or []
    if len(times) != len(samples):
        return finite(samples), []
    kept = [time for time, sample in zip(times, samples, strict=True) if finite([sample])]
    known = finite(kept)
    going = len(known) == len(kept) > 1 and 0 <= known[0] < known[-1] and all(a <= b for a, b in pairwise(known))
    return finite(samples), known if going else []


def _span(variants: Sequence[Sampled], limit: float | None, start: float, end: float) -> Axis:
    low = min(variant.at(0.001) for variant in variants)
    high = max(max(variant.at(0.995), 1.05 * variant.at(0.99)) for variant in variants)
    reach = [low, high]
    if limit is not None and limit < 1.6 * high:
        reach.append(limit * 1.02)
    return axis_for(reach, start, end, pad=0.03)


def beyond(variants: Sequence[Sampled], limit: float | None) -> str:
    """Return a sentence about the samples that lie beyond the end of the axis."""
    axis = _span(variants, limit, 0, 1)
    found = []
    for variant in variants:
        missing = sum(sample > axis.high for sample in variant.samples)
        if missing:
            share = f"{fixed(missing, 0)} of {fixed(len(variant.samples), 0)}"
            found.append(f"{variant.name}: {share}, up to {significant(variant.ordered[-1])} ms")
    return "Beyond the right end: " + "; ".join(found) + "." if found else ""


def distribution(variants: Sequence[Sampled], aim: Latency, width: int) -> str:
    """Return the cumulative share of inferences over latency, with one histogram below for each variant."""
    left, right, top = 46, width - 14, 36
    bottom = top + (200 if width > 500 else 170)
    height = bottom + 50 + STRIP * len(variants)
    medians = ", ".join(f"{variant.name} {significant(variant.at(0.5))} ms" for variant in variants)
    canvas = Canvas(f"spread-{width}", width, height, "Distribution of latency", f"Median latency: {medians}.")
    axis = _span(variants, aim.limit, left, right)
    up = Axis(0, 1, bottom, top)
    for share in (0, 0.25, 0.5, 0.75, 1):
        canvas.line(left, up(share), right, up(share), "grid")
        canvas.text(left - 6, up(share) + 4, f"{share:.0%}".replace("%", " %"), "tick", "end")
    canvas.text(0, 12, "share of inferences that are done within …", "note")
    canvas.across(axis, bottom, top, 9 if width > 500 else 5)
    _limit_line(canvas, axis, aim, top, height - 4)
    for variant in variants:
        _cumulative(canvas, variant, axis, up, len(variants) == 1)
    canvas.text(right, bottom + 31, "latency, ms" + (" (logarithmic)" if axis.log else ""), "note halo", "end")
    for index, variant in enumerate(variants):
        _strip(canvas, variant, axis, bottom + 46 + STRIP * index)
    return canvas.svg()


def _limit_line(canvas: Canvas, axis: Axis, aim: Latency, top: float, bottom: float) -> None:
    limit = aim.limit
    if limit is None or not axis.holds(limit):
        return
    canvas.line(axis(limit), top, axis(limit), bottom, "limit")
    anchor = "end" if axis.share(limit) > 0.5 else "start"
    canvas.text(
        axis(limit) + (4 if anchor == "end" else -4), top - 5, f"{aim.word} {tick(limit)} ms", "limit-text", anchor
    )


def _cumulative(canvas: Canvas, variant: Sampled, axis: Axis, up: Axis, named: bool) -> None:
    points = [(axis(sample), up(share)) for sample, share in ecdf(variant.ordered) if sample <= axis.high]
    if not points:
        return
    line = [(points[0][0], up(0)), *points]
    if variant.ordered[-1] <= axis.high:
        line.append((axis.end, up(1)))
    tip = f"{variant.name}: {_numbers(variant)}"
    canvas.steps(line, f"line {variant.css}", tip)
    for name, share in variant.marks.items():
        if axis.holds(variant.at(share)):
            x, y = axis(variant.at(share)), up(share)
            canvas.add("circle", f"dot {variant.css}", f"{name} {significant(variant.at(share))} ms", cx=x, cy=y, r=3.5)
            if named:
                canvas.text(x + 7, y + 14, name, "tick halo")


def _numbers(variant: Sampled) -> str:
    return " · ".join(f"{name} {significant(variant.at(share))}" for name, share in variant.marks.items()) + " ms"


def _strip(canvas: Canvas, variant: Sampled, axis: Axis, top: float) -> None:
    base = top + STRIP - 12
    counts = histogram(variant.samples, axis.share, 120 if canvas.width > 500 else 60)
    step, peak = (axis.end - axis.start) / len(counts), max([*counts, 1])
    bars = "".join(
        f"M{axis.start + index * step:.1f} {base:.1f}v{-24 * found / peak:.1f}h{step:.2f}V{base:.1f}z"
        for index, found in enumerate(counts)
        if found
    )
    canvas.add("path", f"fill {variant.css}", f"{variant.name}: {len(variant.samples)} samples", d=bars or "M0 0")
    canvas.line(axis.start, base, axis.end, base, "axis")
    for share in variant.marks.values():
        if axis.holds(variant.at(share)):
            spot = axis(variant.at(share))
            canvas.line(spot, base - 2, spot, base + 5, f"mark {variant.css}")
    numbers = _numbers(variant)
    room = canvas.width - len(numbers) * 6.2 - 20
    canvas.text(0, top + 4, shorten(variant.name, room), f"name halo ink {variant.css}")
    canvas.text(axis.end, top + 4, numbers, "tick halo", "end")
