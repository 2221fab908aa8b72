"""Chart: two numbers of each variant or board against each other; intervals, limits, and the front that none beats."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vlatool.render._format import is_share, tick
from vlatool.render.charts.labels import Box, Mark, labels
from vlatool.render.charts.svg import CHARACTER, Axis, Canvas, axis_for
from vlatool.report import Measurement


@dataclass(frozen=True)
class Point:
    """One variant or board.

    Args:
        name, css: Name of the point, and the class of its colour.
        x, y: Values on the axes.
        tip: Shown when the pointer rests on it.
        shape: ``square``, ``ringed``, ``hollow`` or ``dot``.
    """

    name: str
    css: str
    x: Measurement
    y: Measurement
    tip: str
    shape: str = "dot"


@dataclass(frozen=True)
class Bound:
    """A limit on one of the numbers, and what it is called in the drawing."""

    value: float
    words: str


@dataclass(frozen=True)
class Scatter:
    """What is drawn.

    Args:
        key: Begins the ids of the drawing.
        points: Points, at least two.
        across, up: Titles of the axes.
        spoken: The points in words.
        most: The limit on the number that goes across.
        least: The limit on the number that goes up.
        smaller: Whether a smaller number is better on the axis that goes up.
        flipped: Whether that axis has its smallest number at the top.
    """

    key: str
    title: str
    points: tuple[Point, ...]
    across: str
    up: str
    spoken: str
    most: Bound | None = None
    least: Bound | None = None
    smaller: bool = False
    flipped: bool = False

    def front(self) -> list[Point]:
        """Return the points that no other one beats in both respects, fastest first."""
        sign = -1 if self.smaller else 1
        best: list[Point] = []
        for point in sorted(self.points, key=lambda item: (item.x.value, -sign * item.y.value)):
            if not best or sign * point.y.value > sign * best[-1].y.value:
                best.append(point)
        return best

    def draw(self, width: int) -> Canvas:
        """Return the drawing."""
        height = 370 if width > 500 else 325
        frame = (52.0, 26.0, width - 14.0, height - 40.0)
        axes = _axes(self, frame)
        canvas = Canvas(f"{self.key}-{width}", width, height, self.title, self.spoken)
        _background(canvas, self, axes, frame)
        taken = _limits(canvas, self, axes, frame)
        if len(best := self.front()) > 1:
            canvas.steps([(axes[0](point.x.value), axes[1](point.y.value)) for point in best], "front", "Pareto front")
        for point in self.points:
            taken += _whiskers(canvas, point, axes)
        marks = [_point(canvas, point, axes) for point in self.points]
        named = labels(marks, (frame[0], 16.0, width - 4.0, frame[3]), taken, width * 0.45)
        named.draw(canvas, height)
        canvas.height += round(named.height)
        return canvas


Axes = tuple[Axis, Axis]


def _ends(item: Measurement) -> list[float]:
    return [value for value in (item.low, item.value, item.high) if value is not None and math.isfinite(value)]


def _axes(plot: Scatter, frame: Box) -> Axes:
    left, top, right, bottom = frame
    xs = [value for point in plot.points for value in _ends(point.x)]
    if plot.most is not None and plot.most.value < 3 * max(xs):
        xs.append(plot.most.value)
    across = axis_for(xs, left, right, zero=True)
    ys = [value for point in plot.points for value in _ends(point.y)]
    if plot.least is not None:
        ys.append(plot.least.value)
    if plot.smaller:
        return across, axis_for(ys, *((top, bottom) if plot.flipped else (bottom, top)), zero=True)
    low, high = min(ys), max(ys)
    room = (high - low) * 0.08 or 0.02
    most = 1.0 if is_share(plot.points[0].y) and high <= 1 else high + room
    return across, Axis(max(0.0, low - room), min(most, high + room) if high < most else most, bottom, top)


def _background(canvas: Canvas, plot: Scatter, axes: Axes, frame: Box) -> None:
    left, top, right, bottom = frame
    across, up = axes
    factor = 100 if is_share(plot.points[0].y) else 1
    canvas.up(up, left, right, {value: tick(value * factor) for value in up.ticks(5)})
    canvas.across(across, bottom, top, 9 if canvas.width > 500 else 5)
    canvas.text(0, 12, plot.up, "note")
    scale = " (logarithmic)" if across.log else ""
    canvas.text(right, bottom + 32, f"{plot.across}{scale}", "note", "end")


def _limits(canvas: Canvas, plot: Scatter, axes: Axes, frame: Box) -> list[Box]:
    """Draw the limits; return what their lines and words cover."""
    left, top, right, bottom = frame
    taken: list[Box] = []
    if plot.most is not None and axes[0].holds(plot.most.value):
        spot = axes[0](plot.most.value)
        canvas.add("rect", "outside", x=spot, y=top, width=right - spot, height=bottom - top)
        canvas.line(spot, top, spot, bottom, "limit")
        canvas.text(spot - 5, bottom - 8, plot.most.words, "limit-text", "end")
        words = (spot - 5 - len(plot.most.words) * CHARACTER, bottom - 18, spot + 2, bottom - 4)
        taken += [(spot - 1, top, spot + 1, bottom), words]
    if plot.least is not None and axes[1].holds(plot.least.value):
        spot = axes[1](plot.least.value)
        canvas.add("rect", "outside", x=left, y=spot, width=right - left, height=bottom - spot)
        canvas.line(left, spot, right, spot, "limit")
        canvas.text(left + 5, spot + 13, plot.least.words, "limit-text")
        words = (left, spot, left + 5 + len(plot.least.words) * CHARACTER, spot + 16)
        taken += [(left, spot - 1, right, spot + 1), words]
    return taken


def _whiskers(canvas: Canvas, point: Point, axes: Axes) -> list[Box]:
    """Draw the intervals of a point; return what they cover."""
    x, y = axes[0](point.x.value), axes[1](point.y.value)
    ends = []
    if point.y.low is not None and point.y.high is not None:
        ends.append((x, axes[1](point.y.high), x, axes[1](point.y.low)))
    if point.x.low is not None and point.x.high is not None:
        ends.append((axes[0](point.x.low), y, axes[0](point.x.high), y))
    for whisker in ends:
        canvas.line(*whisker, f"whisker {point.css}")
    return [(left - 1, min(top, bottom) - 1, right + 1, max(top, bottom) + 1) for left, top, right, bottom in ends]


def _point(canvas: Canvas, point: Point, axes: Axes) -> Mark:
    x, y = axes[0](point.x.value), axes[1](point.y.value)
    if point.shape == "square":
        canvas.add("rect", f"dot {point.css}", point.tip, x=x - 5, y=y - 5, width=10, height=10)
    else:
        if point.shape == "ringed":
            canvas.add("circle", f"ring {point.css}", cx=x, cy=y, r=9.5)
        css = "hollow" if point.shape == "hollow" else "dot"
        canvas.add("circle", f"{css} {point.css}", point.tip, cx=x, cy=y, r=5.5)
    return Mark(x, y, point.name, point.css)
