"""Chart: how often each variant succeeds as a disturbance gets stronger, a small drawing for each disturbance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vlatool.render._format import tick
from vlatool.render.charts.shares import Share, percent
from vlatool.render.charts.svg import Axis, Canvas, shorten

TALL, HEAD, FOOT, LEFT_MARGIN, GAP = 118.0, 30.0, 20.0, 42.0, 14.0
TOP = 24.0
"""Of the line that names the variants."""
SPACING = 3.0
"""Pixels between the variants at one strength, so that no interval covers another."""


@dataclass(frozen=True)
class Curve:
    """One variant under one disturbance.

    Args:
        css: Class of its colour.
        points: Strength, and how often it succeeds then; in the order of strength.
    """

    variant: str
    css: str
    points: Sequence[tuple[float, Share]]


def curves(groups: Sequence[tuple[str, Sequence[Curve]]], title: str, width: int) -> Canvas:
    """Return the drawing: a panel for each disturbance (and its curves), the worst first, all on the same axes."""
    columns = min(len(groups), 3 if width > 500 else 2)
    wide = (width - GAP * (columns - 1)) / columns
    named = {curve.variant: curve.css for _, group in groups for curve in group}
    rows = -(-len(groups) // columns)
    height = TOP + rows * (HEAD + TALL + FOOT + GAP) + 10
    words = (f"{name} at strength {tick(strength)}: {share.text}"
            for name, group in groups for curve in group for strength, share in curve.points)  # fmt: skip
    canvas = Canvas(f"curves-{width}", width, round(height), title, "; ".join(words))
    canvas.legend(named)
    every = [point for _, group in groups for curve in group for point in curve.points]
    least = min(share.value if share.low is None else share.low for _, share in every)
    across = (min(strength for strength, _ in every), max(strength for strength, _ in every))
    for number, (name, group) in enumerate(groups):
        left, top = (number % columns) * (wide + GAP), TOP + number // columns * (HEAD + TALL + FOOT + GAP)
        _panel(canvas, name, group, (left, top, wide), across, max(0.0, min(0.9, least - 0.02)))
    canvas.text(width, height - 2, "strength of the disturbance", "note", "end")
    return canvas


def _panel(
    canvas: Canvas,
    name: str,
    group: Sequence[Curve],
    box: tuple[float, float, float],
    strengths: tuple[float, float],
    least: float,
) -> None:
    left, top, wide = box
    base = top + HEAD + TALL
    across = Axis(*strengths, left + LEFT_MARGIN + 6, left + wide - 10)
    up = Axis(least, 1.0, base, top + HEAD)
    canvas.text(left, top + 14, shorten(name, wide), "name")
    canvas.up(up, left + LEFT_MARGIN, left + wide, {value: f"{percent(value)} %" for value in up.ticks(4)})
    canvas.line(left + LEFT_MARGIN, base, left + wide, base, "axis")
    for strength in sorted({strength for curve in group for strength, _ in curve.points}):
        canvas.text(across(strength), base + 15, tick(strength), "tick", "middle")
    for number, curve in enumerate(group):
        aside = SPACING * (number - (len(group) - 1) / 2)
        spots = [(across(strength) + aside, share) for strength, share in curve.points]
        line = "L".join(f"{x:.1f} {up(share.value):.1f}" for x, share in spots)
        canvas.add("path", f"line {curve.css}", d=f"M{line}", fill="none")
        for x, share in spots:
            if share.low is not None and share.high is not None:
                canvas.line(x, up(share.low), x, up(share.high), f"whisker {curve.css}")
            canvas.add("circle", f"dot {curve.css}", share.text, cx=x, cy=up(share.value), r=3.5)
