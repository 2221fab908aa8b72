"""Chart: the loss of every step of a training, and when its rounds of episodes were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vlatool.render._format import fixed_decimals, significant, tick
from vlatool.render.charts.samples import envelope
from vlatool.render.charts.svg import Axis, Canvas, axis_for
from vlatool.render.charts.timeline import draw_bands

HEIGHT, LEFT_MARGIN, RIGHT, TOP = 170, 54.0, 14.0, 26.0
ENDS = 20
"""The loss at the start and at the end are means of this part of the steps each."""


@dataclass(frozen=True)
class Curve:
    """One training.

    Args:
        name: Name of the variant, and the stage.
        losses: Losses of the steps, all finite, two or more.
        rounds: Steps before which rows were added.
        css: Class of the variant's colour.
    """

    name: str
    losses: Sequence[float]
    rounds: Sequence[int]
    css: str

    @property
    def ends(self) -> tuple[float, float]:
        """The mean loss of the first and of the last steps."""
        few = max(1, len(self.losses) // ENDS)
        return sum(self.losses[:few]) / few, sum(self.losses[-few:]) / few


def loss_curve(curve: Curve, key: str, width: int) -> Canvas:
    """Return the drawing of one training, with a unique key in the page, so many pixels wide."""
    first, last = curve.ends
    words = f"Loss {significant(first)} in the first steps, {significant(last)} in the last."
    canvas = Canvas(f"loss-{key}-{width}", width, HEIGHT, f"Loss of {curve.name}", words)
    base, right = HEIGHT - 34.0, width - RIGHT
    steps = [float(step + 1) for step in range(len(curve.losses))]
    across = Axis(1.0, steps[-1], LEFT_MARGIN, right)
    bands = envelope(steps, curve.losses, min(len(steps), 180 if width > 500 else 90))
    up = axis_for([edge for band in bands for edge in (band.low, band.high)], base, TOP)
    canvas.up(up, LEFT_MARGIN, right, {value: tick(value) for value in up.ticks(4)})
    canvas.across(across, base, base, 8 if width > 500 else 4)
    for step in curve.rounds:
        canvas.line(across(step), TOP, across(step), base, "limit")
    draw_bands(canvas, bands, across, up, curve.css)
    canvas.heading(14, right, curve.name, f"{fixed_decimals(len(steps), 0)} steps", f"name ink halo {curve.css}")
    canvas.text(right, HEIGHT - 4, "step", "note", "end")
    return canvas
