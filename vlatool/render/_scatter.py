"""Chart: accuracy, or memory where accuracy is not known, against latency: intervals, limits, the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from vlatool.render._format import full, is_share, label, number, quantity, tick, unit
from vlatool.render._labels import Box, Mark, labels
from vlatool.render._svg import CHARACTER, Axis, Canvas, axis_for, series
from vlatool.render._view import ERRORS, Latency, accuracy, floor, latency, measured
from vlatool.report import Measurement, Report

FOOTPRINT = ("peak_rss", "steady_rss", "size")


@dataclass(frozen=True)
class Point:
    """One variant with a measured latency and a measured accuracy."""

    name: str
    role: str
    css: str
    x: Measurement
    y: Measurement


def upright(report: Report) -> str:
    """Return the name of the number that is drawn against latency: the accuracy, else memory or size."""
    if found := accuracy(report):
        return found
    across = measured(report, latency(report).name)
    for name in FOOTPRINT:
        pairs = zip(across, measured(report, name), strict=True)
        if sum(x is not None and y is not None and x.known and y.known for x, y in pairs) > 1:
            return name
    return ""


def points(report: Report) -> list[Point]:
    """Return the variants of which both numbers were measured."""
    across, up = latency(report).name, upright(report)
    found = []
    for row, css in zip(report.rows, series(report.rows), strict=True):
        x, y = row.get(across), row.get(up)
        if x is not None and y is not None and math.isfinite(x.value) and math.isfinite(y.value):
            found.append(Point(row.name, row.role, css, x, y))
    return found


def front(found: Sequence[Point]) -> list[Point]:
    """Return the points that no other one beats in both respects, fastest first."""
    sign = -1 if found and found[0].y.name in (*ERRORS, *FOOTPRINT) else 1
    best: list[Point] = []
    for point in sorted(found, key=lambda item: (item.x.value, -sign * item.y.value)):
        if not best or sign * point.y.value > sign * best[-1].y.value:
            best.append(point)
    return best


def _ends(item: Measurement) -> list[float]:
    return [value for value in (item.low, item.value, item.high) if value is not None and math.isfinite(value)]


def _axes(found: Sequence[Point], aim: Latency, least: float | None, frame: Box) -> tuple[Axis, Axis]:
    left, top, right, bottom = frame
    xs = [value for point in found for value in _ends(point.x)]
    if aim.limit is not None and aim.limit < 3 * max(xs):
        xs.append(aim.limit)
    across = axis_for(xs, left, right, zero=True)
    ys = [value for point in found for value in _ends(point.y)]
    if least is not None:
        ys.append(least)
    if found[0].y.name in ERRORS:
        return across, axis_for(ys, top, bottom, zero=True)
    if found[0].y.name in FOOTPRINT:
        return across, axis_for(ys, bottom, top, zero=True)
    low, high = min(ys), max(ys)
    room = (high - low) * 0.08 or 0.02
    most = 1.0 if is_share(found[0].y) and high <= 1 else high + room
    return across, Axis(max(0.0, low - room), min(most, high + room) if high < most else most, bottom, top)


def scatter(report: Report, width: int) -> str:
    """Return the drawing; call it when there are at least two points."""
    found, aim = points(report), latency(report)
    least = floor(report, found[0].y.name)
    height = 360 if width > 500 else 320
    frame = (46.0, 26.0, width - 14.0, height - 40.0)
    across, up = _axes(found, aim, least, frame)
    spoken = "; ".join(f"{point.name}: {quantity(point.x)}, {full(point.y)}" for point in found)
    title = f"{label(found[0].y.name)} against {label(aim.name)}"
    marks = [Mark(across(point.x.value), up(point.y.value), point.name, point.css) for point in found]
    inside = (46.0, 16.0, width - 4.0, height - 40.0)
    named = labels(marks, inside, _limit_boxes(across, up, aim, least, frame), width * 0.45)
    canvas = Canvas(f"scatter-{width}", width, height + round(named.height), title, spoken)
    _background(canvas, found[0], across, up, frame)
    _limits(canvas, across, up, aim, least, frame)
    _front(canvas, front(found), across, up)
    for point in found:
        _whiskers(canvas, point, across, up)
    for point in found:
        _point(canvas, point, across(point.x.value), up(point.y.value))
    named.draw(canvas, height)
    return canvas.svg()


def _background(canvas: Canvas, first: Point, across: Axis, up: Axis, frame: Box) -> None:
    left, top, right, bottom = frame
    factor = 100 if is_share(first.y) else 1
    for value in up.ticks(5):
        canvas.line(left, up(value), right, up(value), "grid")
        canvas.text(left - 6, up(value) + 4, tick(value * factor), "tick", "end")
    canvas.across(across, bottom, top, 9 if canvas.width > 500 else 5)
    better = "better is up: smaller" if first.y.name in ERRORS else unit(first.y)
    canvas.text(0, 12, ", ".join(part for part in (label(first.y.name), better) if part), "note")
    scale = " (logarithmic)" if across.log else ""
    canvas.text(right, bottom + 32, f"{label(first.x.name)}, {first.x.unit}{scale}", "note", "end")


def _limit_boxes(across: Axis, up: Axis, aim: Latency, least: float | None, frame: Box) -> list[Box]:
    """Return what the lines of the limits and their words cover."""
    left, top, right, bottom = frame
    boxes: list[Box] = []
    if aim.limit is not None and across.holds(aim.limit):
        spot, text = across(aim.limit), _limit_words(aim)
        boxes.append((spot - 1, top, spot + 1, bottom))
        boxes.append((spot - 5 - len(text) * CHARACTER, bottom - 18, spot + 2, bottom - 4))
    if least is not None and up.holds(least):
        spot, text = up(least), _least_words(least)
        boxes.append((left, spot - 1, right, spot + 1))
        boxes.append((left, spot, left + 5 + len(text) * CHARACTER, spot + 16))
    return boxes


def _limit_words(aim: Latency) -> str:
    return f"{aim.word} {tick(aim.limit or 0.0)} ms"


def _least_words(least: float) -> str:
    return f"at least {number(round(least * 100, 2))} %"


def _limits(canvas: Canvas, across: Axis, up: Axis, aim: Latency, least: float | None, frame: Box) -> None:
    left, top, right, bottom = frame
    if aim.limit is not None and across.holds(aim.limit):
        spot, text = across(aim.limit), _limit_words(aim)
        canvas.add("rect", "outside", x=spot, y=top, width=right - spot, height=bottom - top)
        canvas.line(spot, top, spot, bottom, "limit")
        canvas.text(spot - 5, bottom - 8, text, "limit-text", "end")
    if least is not None and up.holds(least):
        spot, text = up(least), _least_words(least)
        canvas.add("rect", "outside", x=left, y=spot, width=right - left, height=bottom - spot)
        canvas.line(left, spot, right, spot, "limit")
        canvas.text(left + 5, spot + 13, text, "limit-text")


def _front(canvas: Canvas, best: Sequence[Point], across: Axis, up: Axis) -> None:
    if len(best) < 2:
        return
    canvas.steps([(across(point.x.value), up(point.y.value)) for point in best], "front", "Pareto front")


def _whiskers(canvas: Canvas, point: Point, across: Axis, up: Axis) -> None:
    x, y = across(point.x.value), up(point.y.value)
    if point.y.low is not None and point.y.high is not None:
        canvas.line(x, up(point.y.low), x, up(point.y.high), f"whisker {point.css}")
    if point.x.low is not None and point.x.high is not None:
        canvas.line(across(point.x.low), y, across(point.x.high), y, f"whisker {point.css}")


def _point(canvas: Canvas, point: Point, x: float, y: float) -> None:
    tip = f"{point.name}: {label(point.x.name)} {full(point.x)}, {label(point.y.name)} {full(point.y)}"
    if point.role == "baseline":
        canvas.add("rect", f"dot {point.css}", tip, x=x - 5, y=y - 5, width=10, height=10)
        return
    if point.role == "chosen":
        canvas.add("circle", f"ring {point.css}", cx=x, cy=y, r=9.5)
    hollow = "hollow " if point.role == "outside" else "dot "
    canvas.add("circle", f"{hollow}{point.css}", tip, cx=x, cy=y, r=5.5)
