"""Chart: how the latencies of the variants are spread."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.files.printable import amount
from vlatool.render._format import fixed_decimals, significant, tick
from vlatool.render._view import Latency
from vlatool.render.charts.samples import Sampled, ecdf, histogram
from vlatool.render.charts.svg import Axis, Canvas, axis_for

STRIP = 52


def beyond(variants: Sequence[Sampled], limit: float | None) -> str:
    """Return a sentence about the samples that lie beyond the end of the axis."""
    axis = _span(variants, limit, 0, 1)
    outliers = []
    for variant in variants:
        outside = sum(sample > axis.high for sample in variant.samples)
        if outside:
            share = f"{fixed_decimals(outside, 0)} of {fixed_decimals(len(variant.samples), 0)}"
            outliers.append(f"{variant.name}: {share}, up to {significant(variant.ordered[-1])} ms")
    return "Beyond the right end: " + "; ".join(outliers) + "." if outliers else ""


def distribution(variants: Sequence[Sampled], aim: Latency, width: int) -> Canvas:
    """Return the cumulative share of inferences over latency, with one histogram below for each variant."""
    left, right, top = 46, width - 14, 36
    bottom = top + (200 if width > 500 else 170)
    height = bottom + 50 + STRIP * len(variants)
    medians = ", ".join(f"{variant.name} {significant(variant.at(0.5))} ms" for variant in variants)
    canvas = Canvas(f"spread-{width}", width, height, "Distribution of latency", f"Median latency: {medians}.")
    axis = _span(variants, aim.limit, left, right)
    up = Axis(0, 1, bottom, top)
    canvas.up(up, left, right, {share: f"{share * 100:g} %" for share in (0, 0.25, 0.5, 0.75, 1)})
    canvas.text(0, 12, "share of inferences that are done within …", "note")
    canvas.across(axis, bottom, top, 9 if width > 500 else 5)
    _limit_line(canvas, axis, aim, top, height - 4)
    for variant in variants:
        _cumulative(canvas, variant, axis, up, len(variants) == 1)
    canvas.text(right, bottom + 31, "latency, ms" + (" (logarithmic)" if axis.log else ""), "note halo", "end")
    for index, variant in enumerate(variants):
        _strip(canvas, variant, axis, bottom + 46 + STRIP * index)
    return canvas


def _span(variants: Sequence[Sampled], limit: float | None, start: float, end: float) -> Axis:
    low = min(variant.at(0.001) for variant in variants)
    high = max(max(variant.at(0.995), 1.05 * variant.at(0.99)) for variant in variants)
    reach = [low, high]
    if limit is not None and limit < 1.6 * high:
        reach.append(limit * 1.02)
    return axis_for(reach, start, end, pad=0.03)


def _limit_line(canvas: Canvas, axis: Axis, aim: Latency, top: float, bottom: float) -> None:
    limit = aim.limit
    if limit is None or not axis.holds(limit):
        return
    canvas.line(axis(limit), top, axis(limit), bottom, "limit")
    anchor = "end" if axis.share(limit) > 0.5 else "start"
    aside = 4 if anchor == "end" else -4
    canvas.text(axis(limit) + aside, top - 5, f"{aim.word} {tick(limit)} ms", "limit-text", anchor)


def _cumulative(canvas: Canvas, variant: Sampled, axis: Axis, up: Axis, named: bool) -> None:
    points = [(axis(sample), up(share)) for sample, share in ecdf(variant.ordered) if sample <= axis.high]
    if not points:
        return
    line = [(points[0][0], up(0)), *points]
    if variant.ordered[-1] <= axis.high:
        line.append((axis.end, up(1)))
    canvas.steps(line, f"line {variant.css}", f"{variant.name}: {_numbers(variant)}")
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
        f"M{axis.start + index * step:.1f} {base:.1f}v{-24 * count / peak:.1f}h{step:.2f}V{base:.1f}z"
        for index, count in enumerate(counts)
        if count
    )
    canvas.add(
        "path", f"fill {variant.css}", f"{variant.name}: {amount(len(variant.samples), 'sample')}", d=bars or "M0 0"
    )
    canvas.line(axis.start, base, axis.end, base, "axis")
    for share in variant.marks.values():
        if axis.holds(variant.at(share)):
            spot = axis(variant.at(share))
            canvas.line(spot, base - 2, spot, base + 5, f"mark {variant.css}")
    canvas.heading(top + 4, axis.end, variant.name, _numbers(variant), f"name halo ink {variant.css}")
