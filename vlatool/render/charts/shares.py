"""Chart: how often each variant succeeds, by task or by disturbance, with the interval of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vlatool.render._format import number
from vlatool.render.charts.svg import Axis, Canvas, shorten

LINE, GAP, TOP, FOOT, HEAD = 13.0, 12.0, 8.0, 34.0, 16.0


@dataclass(frozen=True)
class Share:
    """How often one variant succeeds.

    Args:
        css: Class of its colour.
        value, low, high: Shares from 0 to 1; ends of the interval are None when they are not known.
        count: Episodes.
    """

    variant: str
    css: str
    value: float
    low: float | None
    high: float | None
    count: int

    @property
    def text(self) -> str:
        """The share in words."""
        span = "" if self.low is None or self.high is None else f" ({percent(self.low)} to {percent(self.high)} %)"
        return f"{self.variant}: {percent(self.value)} %{span} of {self.count} episodes"


def shares(groups: Sequence[tuple[str, Sequence[Share]]], title: str, key: str, width: int) -> Canvas:
    """Return the drawing: a group a block, a variant a line in it.

    Args:
        groups: Title -> the shares of the variants, the worst first.
        key: Unique key in the page.
        width: Width in pixels.
    """
    left = min(0.34 * width, 12.0 + 6.2 * max(len(name) for name, _ in groups))
    named = {share.variant: share.css for _, group in groups for share in group}
    top = TOP + (HEAD if len(named) > 1 else 0.0)
    height = top + sum(GAP + LINE * len(group) for _, group in groups) + FOOT
    words = "; ".join(f"{name}: {', '.join(share.text for share in group)}" for name, group in groups)
    canvas = Canvas(f"shares-{key}-{width}", width, round(height), title, words)
    least = min(share.value if share.low is None else share.low for _, group in groups for share in group)
    across = Axis(max(0.0, min(0.9, least - 0.02)), 1.0, left + 8, width - 24.0)
    base = height - FOOT
    for value in across.ticks(6 if width > 500 else 4):
        canvas.line(across(value), top, across(value), base, "grid")
        canvas.text(across(value), base + 15, f"{percent(value)} %", "tick", "middle")
    canvas.line(across.start, base, across.end, base, "axis")
    y = top + GAP
    if len(named) > 1:
        canvas.legend(named)
    for name, group in groups:
        canvas.text(0, y + LINE * (len(group) - 1) / 2 + 4, shorten(name, left), "name")
        for share in group:
            _draw(canvas, across, y, share)
            y += LINE
        y += GAP
    canvas.text(across.end, height - 4, "episodes that succeed", "note", "end")
    return canvas


def _draw(canvas: Canvas, across: Axis, y: float, share: Share) -> None:
    if share.low is not None and share.high is not None:
        canvas.line(across(share.low), y, across(share.high), y, f"line {share.css}")
    canvas.add("circle", f"dot {share.css}", share.text, cx=across(share.value), cy=y, r=3.5)


def percent(value: float) -> str:
    """Return a share in per cent, without the sign."""
    return number(round(100 * value, 1))
