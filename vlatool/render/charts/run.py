"""Charts of a robot's run: its path from above, bands of what held when, and lines over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from vlatool.render._format import fixed_decimals, tick
from vlatool.render.charts.svg import SERIES, Axis, Canvas, axis_for, shorten

LEFT_MARGIN, RIGHT_MARGIN, BAND, PANEL, PATH = 58.0, 14.0, 22.0, 120.0, 380.0
MAX_DRAWN = 2000
"""Points of a line that are drawn: of more, every so many."""
Points = Sequence[tuple[float, float]]
Bands = Sequence[tuple[float, float, str]]


def path_from_above(points: Points, marks: Sequence[tuple[float, float, str]], width: int) -> Canvas:
    """Return the path on equal scales: x to the right, y upwards, in metres, from the ring to the dot.

    Args:
        points: x and y of each step, at least one.
        marks: x, y and what happened there.
        width: Width in pixels.
    """
    length = sum(((a - c) ** 2 + (b - d) ** 2) ** 0.5 for (a, b), (c, d) in pairwise(points))
    words = f"{fixed_decimals(length, 2)} m from ({_place(points[0])}) to ({_place(points[-1])})."
    canvas = Canvas(f"path-{width}", width, round(PATH), "Path from above", words)
    every = [*points, *((x, y) for x, y, _ in marks)]
    low, high = ([pick(point[axis] for point in every) for axis in (0, 1)] for pick in (min, max))
    box = (width - LEFT_MARGIN - RIGHT_MARGIN, PATH - 50)
    spans = [max(high[axis] - low[axis], 0.2) * 1.12 for axis in (0, 1)]
    metre = min(box[axis] / spans[axis] for axis in (0, 1))
    middle = [(low[axis] + high[axis]) / 2 for axis in (0, 1)]
    half = [box[axis] / metre / 2 for axis in (0, 1)]
    across = Axis(middle[0] - half[0], middle[0] + half[0], LEFT_MARGIN, width - RIGHT_MARGIN)
    up = Axis(middle[1] - half[1], middle[1] + half[1], PATH - 34, 16)
    canvas.across(across, up.start, up.end, 9 if width > 500 else 5)
    canvas.up(up, across.start, across.end, {value: tick(value) for value in up.ticks(6)})
    _line(canvas, [(across(x), up(y)) for x, y in points], "s-chosen")
    for x, y, word in marks:
        canvas.add("circle", "ring s0", word, cx=across(x), cy=up(y), r=5)
    (x, y), (end_x, end_y) = points[0], points[-1]
    canvas.add("circle", "hollow s-chosen", "start", cx=across(x), cy=up(y), r=4.5)
    canvas.add("circle", "dot s-chosen", "end", cx=across(end_x), cy=up(end_y), r=5)
    canvas.text(width - RIGHT_MARGIN, PATH - 4, "x, m (y upwards)", "note", "end")
    return canvas


def _place(point: tuple[float, float]) -> str:
    return ", ".join(fixed_decimals(value, 2) for value in point)


def bands(rows: Mapping[str, Bands], seconds: float, width: int) -> Canvas:
    """Return a row for each thing that has states, with a band from when to when each state held, in seconds."""
    words = list(dict.fromkeys(word for row in rows.values() for _, _, word in row if word))
    colours = {word: f"s{index % SERIES}" for index, word in enumerate(words)}
    legend = -(-len(words) // (5 if width > 500 else 3)) * 18.0 + 6
    height = legend + len(rows) * (BAND + 22) + 34
    told = "; ".join(f"{name}: {', '.join(dict.fromkeys(word for _, _, word in row if word))}"
                     for name, row in rows.items())  # fmt: skip
    canvas = Canvas(f"bands-{width}", width, round(height), "States over time", told)
    _legend(canvas, colours, width)
    across = Axis(0.0, max(seconds, 1e-3), LEFT_MARGIN, width - RIGHT_MARGIN)
    base = height - 32
    canvas.across(across, base, legend, 9 if width > 500 else 5)
    for number, (name, row) in enumerate(rows.items()):
        top = legend + number * (BAND + 22) + 16
        canvas.text(0, top - 3, name, "name")
        for began, ended, word in row:
            if word:
                left = across(began)
                canvas.add("rect", f"fill {colours[word]}", f"{word}, {began:.1f} to {ended:.1f} s", x=left, y=top,
                           width=max(1.0, across(ended) - left), height=BAND)  # fmt: skip
    canvas.text(width - RIGHT_MARGIN, height - 2, "time, s", "note", "end")
    return canvas


def _legend(canvas: Canvas, colours: Mapping[str, str], width: int) -> None:
    columns = 5 if width > 500 else 3
    for index, (word, css) in enumerate(colours.items()):
        x, y = (index % columns) * width / columns, 12.0 + 18 * (index // columns)
        canvas.add("circle", f"dot {css}", cx=x + 5, cy=y - 4, r=4)
        canvas.text(x + 15, y, shorten(word, width / columns - 24), "name")


def over_time(panels: Mapping[str, Mapping[str, Points]], width: int) -> Canvas:
    """Return a panel for each quantity, its lines over seconds.

    Args:
        panels: Quantity with its unit -> name of a line -> time and value of each point.
    """
    every = [point for lines in panels.values() for points in lines.values() for point in points]
    height = len(panels) * (PANEL + 40) + 24
    canvas = Canvas(f"lines-{width}", width, round(height), "Over time", ", ".join(panels))
    across = Axis(0.0, max([time for time, _ in every] + [1e-3]), LEFT_MARGIN, width - RIGHT_MARGIN)
    for number, (quantity, lines) in enumerate(panels.items()):
        top = number * (PANEL + 40) + 22
        colours = {name: "s-chosen" if len(lines) == 1 else f"s{index % SERIES}" for index, name in enumerate(lines)}
        canvas.text(0, top - 6, quantity, "name")
        for index, (name, css) in enumerate(colours.items() if len(lines) > 1 else ()):
            x = width - RIGHT_MARGIN - (len(colours) - index) * 110
            canvas.add("circle", f"dot {css}", cx=x, cy=top - 10, r=4)
            canvas.text(x + 9, top - 6, shorten(name, 96), "note")
        up = axis_for([value for points in lines.values() for _, value in points] or [0.0], top + PANEL, top, zero=True)
        canvas.up(up, across.start, across.end, {value: tick(value) for value in up.ticks(4)})
        canvas.across(across, top + PANEL, top, 9 if width > 500 else 5)
        for name, points in lines.items():
            _line(canvas, [(across(time), up(value)) for time, value in points], colours[name])
    canvas.text(width - RIGHT_MARGIN, height - 2, "time, s", "note", "end")
    return canvas


def _line(canvas: Canvas, points: Points, css: str) -> None:
    every = max(1, len(points) // MAX_DRAWN)
    drawn = [*points[::every], *points[-1:]]
    if len(drawn) > 1:
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in drawn)
        canvas.add("path", f"line {css}", d=f"M{path}", fill="none")
