"""Accuracy, or memory where accuracy is not known, against latency."""

from __future__ import annotations

import math
from collections.abc import Iterator

from vlatool.measures import Quantity, quantity_of
from vlatool.measures.resources import FOOTPRINT
from vlatool.render._format import full, label, number, plain, tick, unit
from vlatool.render._format import quantity as with_unit
from vlatool.render._view import accuracy, floor, latency, measurements
from vlatool.render.charts.scatter import Bound, Point, Scatter
from vlatool.render.charts.svg import with_colours
from vlatool.render.document import Chart, Section
from vlatool.report import Report

SHAPES = {"baseline": "square", "chosen": "ringed", "outside": "hollow"}
HELP = (
    "and to the left is better. Lines through the points are intervals; the dotted line joins the variants that no "
    "other beats in both. Square: baseline. Ringed: chosen. Hollow: outside the limits."
)


class TradeOff:
    """One point for each variant of which both numbers were measured."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the drawing when there are two points or more."""
        if plot := scatter(report):
            caption = f"{'Down' if quantity_of(plot.points[0].y.name) in FOOTPRINT else 'Up'} {HELP}"
            title = plot.title[:1].upper() + plot.title[1:]
            yield Section(title, (Chart(plot.draw, caption),), 60, "measured")


def upright(report: Report) -> Quantity | None:
    """Return the quantity that is drawn against latency: the accuracy, else memory or size."""
    if (quantity := accuracy(report)) is not None:
        return quantity
    across = measurements(report, latency(report).quantity)
    for quantity in FOOTPRINT:
        pairs = zip(across, measurements(report, quantity), strict=True)
        if sum(x is not None and y is not None and x.known and y.known for x, y in pairs) > 1:
            return quantity
    return None


def points(report: Report) -> list[Point]:
    """Return the variants of which both numbers were measured."""
    across, up = latency(report).quantity, upright(report)
    shown: list[Point] = []
    if up is None:
        return shown
    for row, css in with_colours(report.rows):
        x, y = row.get(across), row.get(up)
        if x is not None and y is not None and math.isfinite(x.value) and math.isfinite(y.value):
            tip = f"{row.name}: {label(x.name)} {full(x)}, {label(y.name)} {full(y)}"
            shown.append(Point(row.name, css, x, y, tip, SHAPES.get(row.role, "dot")))
    return shown


def scatter(report: Report) -> Scatter | None:
    """Return what is drawn; None when there are fewer than two points."""
    shown, aim = points(report), latency(report)
    if len(shown) < 2:
        return None
    x, y = shown[0].x, shown[0].y
    up = quantity_of(y.name)
    least, smaller = floor(report, up), up.better == "less"
    error = smaller and up not in FOOTPRINT
    better = "better is up: smaller" if error else unit(y)
    return Scatter(
        "scatter",
        f"{label(y.name)} against {plain(aim.quantity.words)}",
        tuple(shown),
        f"{label(x.name)}, {x.unit}",
        ", ".join(part for part in (label(y.name), better) if part),
        "; ".join(f"{point.name}: {with_unit(point.x)}, {full(point.y)}" for point in shown),
        None if aim.limit is None else Bound(aim.limit, f"{aim.word} {tick(aim.limit)} ms"),
        None if least is None else Bound(least, f"at least {number(round(least * 100, 2))} %"),
        smaller,
        error,
    )
