"""Chart: how the latencies of the variants are spread, and how they went over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vlatool.render._format import significant, tick
from vlatool.render._samples import ecdf, envelope, finite, histogram, quantile
from vlatool.render._svg import Axis, Canvas, axis_for, series, shorten
from vlatool.report import Report

SERIES_NAME = "latency_ms"
MOST = 8
STRIP = 52
STRETCH = 78


@dataclass(frozen=True)
class Sampled:
    """The latency samples of one variant, in ms: as they came, and ordered."""

    name: str
    css: str
    samples: list[float]
    ordered: list[float]

    known: Mapping[float, float]

    def at(self, share: float) -> float:
        """Return a quantile in ms; the reported one where the report has it."""
        return self.known.get(share) or quantile(self.ordered, share)


def left_out(report: Report) -> str:
    """Return a sentence about the variants for which the charts have no room."""
    more = sum(len(finite(row.raw.get(SERIES_NAME) or [])) > 1 for row in report.rows) - MOST
    return f"Only the first {MOST} variants are drawn; {more} more in the tables." if more > 0 else ""


def sampled(report: Report) -> list[Sampled]:
    """Return the variants that kept latency samples, the first eight at most."""
    found = []
    for row, css in zip(report.rows, series(report.rows), strict=True):
        samples = finite(row.raw.get(SERIES_NAME) or [])
        if len(samples) > 1:
            reported = {0.5: row.value("latency_p50"), 0.99: row.value("latency_p99")}
            known = {share: value for share, value in reported.items() if math.isfinite(value)}
            found.append(Sampled(row.name, css, samples, sorted(samples), known))
    return found[:MOST]


def _span(variants: Sequence[Sampled], limit: float | None, start: float, end: float) -> Axis:
    low = min(variant.at(0.001) for variant in variants)
    high = max(max(variant.at(0.995), 1.05 * variant.at(0.99)) for variant in variants)
    reach = [low, high]
    if limit is not None and limit < 1.6 * high:
        reach.append(limit * 1.02)
    return axis_for(reach, start, end, pad=0.03)


def beyond(report: Report, limit: float | None) -> str:
    """Return a sentence about the samples that lie beyond the end of the axis."""
    variants = sampled(report)
    axis = _span(variants, limit, 0, 1)
    found = []
    for variant in variants:
        missing = sum(sample > axis.high for sample in variant.samples)
        if missing:
            found.append(
                f"{variant.name}: {missing} of {len(variant.samples)}, up to {significant(variant.ordered[-1])} ms"
            )
    return "Beyond the right end: " + "; ".join(found) + "." if found else ""


def distribution(report: Report, limit: float | None, width: int) -> str:
    """Return the cumulative share of inferences over latency, with one histogram below for each variant."""
    variants = sampled(report)
    left, right, top = 46, width - 14, 36
    bottom = top + (200 if width > 500 else 170)
    height = bottom + 50 + STRIP * len(variants)
    medians = ", ".join(f"{variant.name} {significant(variant.at(0.5))} ms" for variant in variants)
    canvas = Canvas(f"spread-{width}", width, height, "Distribution of latency", f"Median latency: {medians}.")
    axis = _span(variants, limit, left, right)
    up = Axis(0, 1, bottom, top)
    for share in (0, 0.25, 0.5, 0.75, 1):
        canvas.line(left, up(share), right, up(share), "grid")
        canvas.text(left - 6, up(share) + 4, f"{share:.0%}".replace("%", " %"), "tick", "end")
    canvas.text(0, 12, "share of inferences that are done within …", "note")
    canvas.across(axis, bottom, top, 9 if width > 500 else 5)
    _limit_line(canvas, axis, limit, top, height - 4)
    for variant in variants:
        _cumulative(canvas, variant, axis, up)
    canvas.text(right, bottom + 31, "latency, ms" + (" (logarithmic)" if axis.log else ""), "note", "end")
    for index, variant in enumerate(variants):
        _strip(canvas, variant, axis, bottom + 46 + STRIP * index)
    return canvas.svg()


def _limit_line(canvas: Canvas, axis: Axis, limit: float | None, top: float, bottom: float) -> None:
    if limit is None or not axis.holds(limit):
        return
    canvas.line(axis(limit), top, axis(limit), bottom, "limit")
    anchor = "end" if axis.share(limit) > 0.5 else "start"
    canvas.text(axis(limit) + (4 if anchor == "end" else -4), top - 5, f"limit {tick(limit)} ms", "limit-text", anchor)


def _cumulative(canvas: Canvas, variant: Sampled, axis: Axis, up: Axis) -> None:
    points = [(axis(sample), up(share)) for sample, share in ecdf(variant.ordered) if sample <= axis.high]
    if not points:
        return
    line = [(points[0][0], up(0)), *points]
    if variant.ordered[-1] <= axis.high:
        line.append((axis.end, up(1)))
    tip = f"{variant.name}: median {significant(variant.at(0.5))} ms, p99 {significant(variant.at(0.99))} ms"
    canvas.steps(line, f"line {variant.css}", tip)


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
    for share in (0.5, 0.99):
        if axis.holds(variant.at(share)):
            spot = axis(variant.at(share))
            canvas.line(spot, base - 2, spot, base + 5, f"mark {variant.css}")
    numbers = f"p50 {significant(variant.at(0.5))} · p99 {significant(variant.at(0.99))} ms"
    room = canvas.width - len(numbers) * 6.2 - 20
    canvas.text(0, top + 4, shorten(variant.name, room), f"name halo ink {variant.css}")
    canvas.text(axis.end, top + 4, numbers, "tick halo", "end")


def over_time(report: Report, limit: float | None, width: int) -> str:
    """Return smallest, median and largest latency along the run, each variant on its own scale."""
    variants = sampled(report)
    height = STRETCH * len(variants) + 22
    worst = ", ".join(f"{variant.name} {significant(variant.ordered[-1])} ms" for variant in variants)
    canvas = Canvas(f"time-{width}", width, height, "Latency along the run", f"Largest latency: {worst}.")
    for index, variant in enumerate(variants):
        _stretch(canvas, variant, limit, STRETCH * index)
    canvas.text(46, height - 4, "first sample", "tick")
    canvas.text(width - 14, height - 4, "last sample", "tick", "end")
    return canvas.svg()


def _stretch(canvas: Canvas, variant: Sampled, limit: float | None, top: float) -> None:
    left, right, base = 46.0, canvas.width - 14.0, top + STRETCH - 12
    high = min(variant.ordered[-1], 2.5 * variant.at(0.95))
    scale = axis_for([variant.ordered[0], max(high, variant.ordered[0] * 1.02)], base, top + 22, pad=0.04)
    for value in scale.ticks(3):
        canvas.line(left, scale(value), right, scale(value), "grid")
        canvas.text(left - 6, scale(value) + 4, tick(value), "tick", "end")
    most = 180 if canvas.width > 500 else 90
    bands = envelope(variant.samples, max(20, min(most, len(variant.samples) // 12)))
    step = (right - left) / len(bands)
    centres = [left + step * (index + 0.5) for index in range(len(bands))]
    upper = [(x, scale(band[2])) for x, band in zip(centres, bands, strict=True)]
    lower = [(x, scale(band[0])) for x, band in zip(centres, bands, strict=True)]
    canvas.area(upper, lower, f"band {variant.css}")
    middle = " ".join(f"{x:.1f},{scale(band[1]):.1f}" for x, band in zip(centres, bands, strict=True))
    canvas.add("polyline", f"line {variant.css}", points=middle, fill="none")
    if limit is not None and scale.holds(limit):
        canvas.line(left, scale(limit), right, scale(limit), "limit")
    numbers = f"{significant(variant.ordered[0])}–{significant(variant.ordered[-1])} ms, n = {len(variant.samples)}"
    canvas.text(0, top + 12, shorten(variant.name, canvas.width - len(numbers) * 6.2 - 20), f"name ink {variant.css}")
    canvas.text(right, top + 12, numbers, "tick", "end")
