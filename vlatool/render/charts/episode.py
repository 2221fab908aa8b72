"""Chart: one episode of several variants: the path from above and from the side, and the actions of each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vlatool.render._format import fixed_decimals, tick
from vlatool.render.charts.svg import Axis, Canvas

ROW, GAP, LEFT_MARGIN, RIGHT, HEAD = 74.0, 18.0, 54.0, 14.0, 22.0
MOST_ACTIONS, MOST_POINTS = 6, 400
DISCRETE = "action"
"""The series of a discrete action: its index, of each step."""
VIEWS = (("x", "y", "from above"), ("x", "z", "from the side"))
Points = list[tuple[float, float]]


@dataclass(frozen=True)
class Played:
    """What one variant did in the episode.

    Args:
        css: Class of its colour.
        series: ``position.x``, ``action.NAME`` (or ``action``) and ``fresh`` -> a number a step.
    """

    variant: str
    css: str
    series: Mapping[str, Sequence[float]]

    @property
    def steps(self) -> int:
        """Control steps."""
        return len(self.series.get("fresh", ()))


def episode(played: Sequence[Played], title: str, width: int) -> Canvas:
    """Return the drawing: paths on top, then an action a row; short marks show where a new chunk begins.

    Args:
        played: The variants, the baseline first.
        title: Which episode it is.
        width: Width in pixels.
    """
    views = [(one, two, words) for one, two, words in VIEWS
             if all({f"position.{one}", f"position.{two}"} <= set(each.series) for each in played)]  # fmt: skip
    actions = [name for name in played[0].series if name.partition(".")[0] == "action"][:MOST_ACTIONS]
    beside = width > 500
    side = (width - GAP) / 2 if beside and len(views) > 1 else float(width)
    tall = min(220.0, 0.8 * side)
    top = HEAD + (tall + GAP) * (min(1, len(views)) if beside else len(views))
    height = top + (ROW + GAP) * len(actions) + 22
    steps = "; ".join(f"{one.variant}: {fixed_decimals(one.steps, 0)} steps" for one in played)
    canvas = Canvas(f"episode-{width}", width, round(height), title, f"{steps}.")
    canvas.legend({one.variant: one.css for one in played})
    for number, view in enumerate(views):
        corner = (number * (side + GAP), HEAD) if beside else (0.0, HEAD + number * (tall + GAP))
        _paths(canvas, played, view, corner, (side, tall))
    across = Axis(1.0, float(max(2, *(one.steps for one in played))), LEFT_MARGIN, width - RIGHT)
    for number, name in enumerate(actions):
        _action(canvas, played, name, across, top + number * (ROW + GAP))
    base = top + (ROW + GAP) * len(actions) - GAP
    canvas.across(across, base, base, 8 if beside else 4)
    canvas.text(width - RIGHT, height - 4, "control step", "note", "end")
    return canvas


def _paths(
    canvas: Canvas,
    played: Sequence[Played],
    view: tuple[str, str, str],
    corner: tuple[float, float],
    size: tuple[float, float],
) -> None:
    """Draw the paths of all variants on equal scales; a dot is the end of one."""
    one, two, words = view
    paths = [(each.css, _thin(list(zip(each.series[f"position.{one}"], each.series[f"position.{two}"], strict=True))))
             for each in played]  # fmt: skip
    every = [point for _, path in paths for point in path]
    low = [min(point[axis] for point in every) for axis in (0, 1)]
    high = [max(point[axis] for point in every) for axis in (0, 1)]
    scale = min((size[axis] - 36) / max(high[axis] - low[axis], 1e-9) for axis in (0, 1))
    for css, path in paths:
        drawn = [(corner[0] + 14 + (px - low[0]) * scale, corner[1] + size[1] - 10 - (py - low[1]) * scale)
                 for px, py in path]  # fmt: skip
        _line(canvas, drawn, css)
        canvas.add("circle", f"dot {css}", cx=drawn[-1][0], cy=drawn[-1][1], r=3.5)
    canvas.text(corner[0], corner[1] + 14, f"path {words} ({one}, {two})", "note")


def _action(canvas: Canvas, played: Sequence[Played], name: str, across: Axis, top: float) -> None:
    values = [value for one in played for value in one.series.get(name, ())]
    low, high = min(values), max(values)
    room = 0.06 * (high - low) or abs(high) * 0.1 or 1.0
    up = Axis(low - room, high + room, top + ROW, top + 12)
    discrete = name == DISCRETE
    canvas.up(up, LEFT_MARGIN, across.end, {value: tick(value) for value in _ticks(up, low, high, discrete)})
    for one in played:
        own = one.series.get(name, ())
        if own:
            points = _thin([(across(float(step)), up(value)) for step, value in enumerate(own, 1)])
            canvas.steps(points, f"line {one.css}") if discrete else _line(canvas, points, one.css)
        for step in _seams(one):
            canvas.line(across(float(step)), top + ROW - 5, across(float(step)), top + ROW, f"mark {one.css}")
    canvas.text(0, top + 8, name.partition(".")[2] or "action", "note")


def _ticks(up: Axis, low: float, high: float, discrete: bool) -> list[float]:
    """Return two round numbers or more; the indices themselves where they are few."""
    if discrete and high - low < MOST_ACTIONS:
        return [float(index) for index in range(round(low), round(high) + 1)]
    return next((found for most in (2, 3, 4) if len(found := up.ticks(most)) > 1), [])


def _seams(one: Played) -> list[int]:
    """Return the steps at which a new chunk begins; none where each step does, or where there are too many."""
    fresh = [step for step, begins in enumerate(one.series.get("fresh", ()), 1) if begins and step > 1]
    return fresh if len(fresh) < one.steps - 1 and one.steps <= MOST_POINTS else []


def _line(canvas: Canvas, points: Points, css: str) -> None:
    canvas.add("path", f"line {css}", d="M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points), fill="none")


def _thin(points: Points) -> Points:
    """Return at most ``MOST_POINTS`` points and the last one."""
    stride = -(-len(points) // MOST_POINTS)
    return points if stride < 2 else [*points[::stride], points[-1]]
