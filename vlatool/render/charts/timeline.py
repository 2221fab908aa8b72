"""Chart: latency over time, with what the machine told about itself on the same time axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from vlatool.files.printable import amount
from vlatool.measures.series import READING, READING_TIMES, THROTTLE_TIMES
from vlatool.measures.tables import TELEMETRY
from vlatool.render._format import fixed_decimals, plain, significant, tick
from vlatool.render._view import Latency
from vlatool.render.charts.samples import Band, Sampled, envelope, finite
from vlatool.render.charts.svg import Axis, Canvas, axis_for
from vlatool.report import Report

PANEL, GAUGE_PANEL, MOST_GAUGES = 104, 56, 6
LEFT_MARGIN, RIGHT_MARGIN = 46.0, 14.0
UNITS = {"degC": "°C", "1": ""}
KINDS = (("degC", "temp", "thermal"), ("Hz", "freq", "clock"), ("W", "power", "vdd"))
"""Units and parts of names by which gauges are put in order: temperature, clock, power."""


@dataclass(frozen=True)
class Gauge:
    """One reading of the machine over time."""

    name: str
    unit: str
    times: list[float]
    values: list[float]


def gauges(report: Report) -> list[Gauge]:
    """Return what was read of the machine, each once: temperatures, clocks, power, the rest."""
    tables = [record for row in report.rows for record in row.details.get(TELEMETRY, ())]
    units = {str(record.get("reading")): str(record.get("unit", "")) for record in tables}
    shown: list[tuple[str, Gauge]] = []
    for row in report.rows:
        for reading, name in READING.among(row.raw).items():
            values, times = row.raw[name], row.raw.get(READING_TIMES.name(reading)) or []
            if len(times) != len(values):
                continue
            pairs = sorted(pair for pair in zip(times, values, strict=True) if len(finite(pair)) == 2)
            gauge = Gauge(reading, units.get(reading, ""), [pair[0] for pair in pairs], [pair[1] for pair in pairs])
            if len(pairs) > 1 and all(gauge != other for _, other in shown):
                shown.append((row.name, gauge))
    readings = [gauge.name for _, gauge in shown]
    several = {name for name in readings if readings.count(name) > 1}
    named = (replace(gauge, name=f"{gauge.name}, {row}") if gauge.name in several else gauge for row, gauge in shown)
    return sorted(named, key=_kind)


def _kind(gauge: Gauge) -> int:
    for index, (unit, *words) in enumerate(KINDS):
        if gauge.unit.endswith(unit) or (not gauge.unit and any(word in gauge.name.lower() for word in words)):
            return index
    return len(KINDS)


def throttle_times(report: Report) -> list[float]:
    """Return the moments at which throttling was seen."""
    return sorted({moment for row in report.rows for moment in finite(row.raw.get(THROTTLE_TIMES) or [])})


def over_time(report: Report, variants: Sequence[Sampled], aim: Latency, width: int) -> Canvas:
    """Return latency on a time axis in seconds, gauges and throttled moments below."""
    readings, moments = gauges(report)[:MOST_GAUGES], throttle_times(report)
    end = max([*(variant.times[-1] for variant in variants), *(gauge.times[-1] for gauge in readings), *moments])
    bottom = PANEL * len(variants) + GAUGE_PANEL * len(readings) + (20 if moments else 0)
    worst = ", ".join(f"{variant.name} {significant(variant.ordered[-1])} ms" for variant in variants)
    throttling = f" Throttled at {amount(len(moments), 'moment')}." if moments else ""
    canvas = Canvas(f"time-{width}", width, bottom + 42, "Latency over time", f"Largest latency: {worst}.{throttling}")
    across = Axis(0.0, end, LEFT_MARGIN, width - RIGHT_MARGIN)
    for value in across.ticks(8 if width > 500 else 4):
        canvas.line(across(value), 22, across(value), bottom, "grid")
        canvas.text(across(value), bottom + 15, tick(value), "tick", "middle")
    if moments:
        spots = sorted({round(across(moment) / 2) * 2 for moment in moments})
        canvas.add("path", "throttle", d="".join(f"M{spot} 22V{bottom}" for spot in spots))
        words = f"throttled: {amount(len(moments), 'moment')}"
        canvas.text(0, PANEL * len(variants) + 14, words, "limit-text halo")
    for index, variant in enumerate(variants):
        panel(canvas, variant, aim, PANEL * index, across, variant.times)
    for index, gauge in enumerate(readings):
        _gauge(canvas, gauge, PANEL * len(variants) + (20 if moments else 0) + GAUGE_PANEL * index, across)
    canvas.line(LEFT_MARGIN, bottom, width - RIGHT_MARGIN, bottom, "axis")
    canvas.text(width - RIGHT_MARGIN, bottom + 32, "seconds since the start of the run", "note", "end")
    return canvas


def along_the_run(variants: Sequence[Sampled], aim: Latency, width: int) -> Canvas:
    """Return latency in the order of the samples, where their times are not known."""
    worst = ", ".join(f"{variant.name} {significant(variant.ordered[-1])} ms" for variant in variants)
    height = PANEL * len(variants) + 22
    canvas = Canvas(f"order-{width}", width, height, "Latency along the run", f"Largest latency: {worst}.")
    for number, variant in enumerate(variants):
        order = [float(index) for index in range(len(variant.samples))]
        panel(canvas, variant, aim, PANEL * number, Axis(0, order[-1], LEFT_MARGIN, width - RIGHT_MARGIN), order)
    canvas.text(LEFT_MARGIN, height - 4, "first sample", "tick")
    canvas.text(width - RIGHT_MARGIN, height - 4, "last sample", "tick", "end")
    return canvas


def panel(canvas: Canvas, variant: Sampled, aim: Latency, top: float, across: Axis, times: Sequence[float]) -> None:
    """Draw smallest, median and largest latency of one variant, on a scale of its own."""
    right, base = canvas.width - RIGHT_MARGIN, top + PANEL - 14
    high = min(variant.ordered[-1], 1.3 * variant.at(0.99))
    scale = axis_for([variant.ordered[0], max(high, variant.ordered[0] * 1.02)], base, top + 24, pad=0.04)
    canvas.up(scale, LEFT_MARGIN, right, {value: tick(value) for value in scale.ticks(4)})
    most = 180 if canvas.width > 500 else 90
    bins = max(20, min(most, len(variant.samples) // 12))
    draw_bands(canvas, envelope(times, variant.samples, bins), across, scale, variant.css)
    if aim.limit is not None and scale.holds(aim.limit):
        canvas.line(LEFT_MARGIN, scale(aim.limit), right, scale(aim.limit), "limit")
    calls = f"n = {fixed_decimals(len(variant.samples), 0)}"
    numbers = f"{significant(variant.ordered[0])}–{significant(variant.ordered[-1])} ms, {calls}"
    canvas.heading(top + 14, right, variant.name, numbers, f"name ink halo {variant.css}")


def draw_bands(canvas: Canvas, bands: Sequence[Band], across: Axis, scale: Axis, css: str) -> None:
    """Draw the median of each stretch as a line, and its spread as bands."""
    centres = [across(band.at) for band in bands]
    for css_of, top, bottom in (("outer", "high", "low"), ("band", "upper", "lower")):
        edges = ([scale(getattr(band, end)) for band in bands] for end in (top, bottom))
        upper, lower = (list(zip(centres, edge, strict=True)) for edge in edges)
        canvas.area(upper, lower, f"{css_of} {css}")
    middle = " ".join(f"{x:.1f},{scale(band.middle):.1f}" for x, band in zip(centres, bands, strict=True))
    canvas.add("polyline", f"line {css}", points=middle, fill="none")


def _gauge(canvas: Canvas, gauge: Gauge, top: float, across: Axis) -> None:
    low, high = min(gauge.values), max(gauge.values)
    scale = axis_for([low, high], top + GAUGE_PANEL - 8, top + 22, pad=0.08)
    unit = UNITS.get(gauge.unit, plain(gauge.unit))
    bands = envelope(gauge.times, gauge.values, min(len(gauge.values), 120 if canvas.width > 500 else 60))
    draw_bands(canvas, bands, across, scale, "s-gauge")
    numbers = f"{significant(low)}–{significant(high)} {unit}".rstrip()
    canvas.heading(top + 14, canvas.width - RIGHT_MARGIN, gauge.name, numbers, "note halo")
