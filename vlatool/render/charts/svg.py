"""Inline SVG by hand: a canvas that escapes, an axis, round ticks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from vlatool.render._format import plain, tick
from vlatool.report import Row

SERIES = 6
CHARACTER = 6.0


@dataclass(frozen=True)
class Axis:
    """Maps numbers between ``low`` and ``high`` to pixels between ``start`` and ``end``."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def share(self, value: float) -> float:
        """Return where the value lies: 0 at ``low``, 1 at ``high``."""
        if self.log:
            return math.log(max(value, 1e-300) / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def __call__(self, value: float) -> float:
        """Return the pixel of a value; values beyond the axis are put on its ends."""
        return self.start + min(1.0, max(0.0, self.share(value))) * (self.end - self.start)

    def holds(self, value: float | None) -> bool:
        """Return whether the value lies on the axis."""
        return value is not None and self.low <= value <= self.high

    def ticks(self, most: int = 6) -> list[float]:
        """Return round numbers inside the axis."""
        rounded = _log_ticks(self.low, self.high, most) if self.log else []
        return rounded if len(rounded) >= 2 else _linear_ticks(self.low, self.high, most)


def _linear_ticks(low: float, high: float, most: int) -> list[float]:
    rough = (high - low) / max(1, most)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [float(f"{index * step:.10g}") for index in range(first, last + 1)]


def _log_ticks(low: float, high: float, most: int) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
        rounded = (factor * 10.0**decade for decade in decades for factor in factors)
        inside = [float(f"{value:.10g}") for value in rounded if low <= value <= high]
        if len(inside) <= most:
            return inside
    return inside


def axis_for(values: Iterable[float], start: float, end: float, *, zero: bool = False, pad: float = 0.06) -> Axis:
    """Return an axis that holds the values, logarithmic when they are positive and span more than a factor of 8."""
    numbers = list(values)
    low, high = min(numbers), max(numbers)
    if low > 0 and high / low > 8:
        grow = (high / low) ** pad
        return Axis(low / grow, high * grow, start, end, log=True)
    room = (high - low) * pad or abs(high) * 0.1 or 1.0
    bottom = 0.0 if zero and low >= 0 else low - room
    return Axis(max(0.0, bottom) if low >= 0 else bottom, high + room, start, end)


def with_colours(rows: Sequence[Row]) -> list[tuple[Row, str]]:
    """Return each row with the class of its colour: the baseline is grey, the chosen one (or the only one) blue."""
    named = {"baseline": "s-base", "chosen": "s-chosen"}
    if sum(row.role != "baseline" for row in rows) == 1:
        return [(row, named.get(row.role, "s-chosen")) for row in rows]
    others = (f"s{index % SERIES}" for index in itertools.count())
    return [(row, named.get(row.role) or next(others)) for row in rows]


def shorten(text: str, width: float) -> str:
    """Return text that fits a width in pixels, with an ellipsis where it was cut."""
    text, most = plain(text), max(4, int(width / CHARACTER))
    return text if len(text) <= most else text[: most - 1] + "…"


class Canvas:
    """One drawing with a title and a description for those who cannot see it.

    Args:
        key: Unique key in the page; names the title and the description.
        width, height: Size in pixels, which may grow; the drawing scales down, and up to its width.
    """

    def __init__(self, key: str, width: int, height: int, title: str, description: str) -> None:
        self.width, self.height = width, height
        self._key = _safe(key)
        self._parts: list[str] = []
        for tag, text in (("title", title), ("desc", description)):
            self.add(tag, inner=text, id=f"{key}-{tag[0]}")

    def add(self, tag: str, css: str = "", tip: str = "", inner: str = "", **attributes: str | float) -> None:
        """Add a shape, or the text ``inner``; ``tip`` is shown when the pointer rests on it."""
        names = {**attributes, "class": css} if css else attributes
        words = [tag, *(f'{key.replace("_", "-")}="{_safe(value)}"' for key, value in names.items())]
        title = f"<title>{_safe(tip)}</title>" if tip else ""
        end = f">{title}{_safe(inner)}</{tag}>" if tip or inner else "/>"
        self._parts.append(f"<{' '.join(words)}{end}")

    def line(self, x1: float, y1: float, x2: float, y2: float, css: str) -> None:
        """Add a straight line."""
        self.add("line", css, x1=x1, y1=y1, x2=x2, y2=y2)

    def text(self, x: float, y: float, content: str, css: str = "", anchor: str = "start") -> None:
        """Add text; ``anchor`` is ``start``, ``middle`` or ``end``."""
        side = {} if anchor == "start" else {"text_anchor": anchor}
        self.add("text", css, x=x, y=y, **side, inner=content)

    def steps(self, points: Sequence[tuple[float, float]], css: str, tip: str = "") -> None:
        """Add a line that goes across, then up or down, to each point."""
        (x, y), *rest = points
        path = f"M{x:.1f} {y:.1f}" + "".join(f"H{px:.1f}V{py:.1f}" for px, py in rest)
        self.add("path", css, tip, d=path, fill="none")

    def area(self, upper: Sequence[tuple[float, float]], lower: Sequence[tuple[float, float]], css: str) -> None:
        """Fill what lies between two lines."""
        outline = [*upper, *reversed(lower)]
        self.add("path", css, d="M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in outline) + "Z")

    def across(self, axis: Axis, y: float, top: float, most: int) -> None:
        """Add the ticks of a horizontal axis at ``y``, with grid lines up to ``top``."""
        for value in axis.ticks(most):
            self.line(axis(value), top, axis(value), y, "grid")
            self.text(axis(value), y + 15, tick(value), "tick", "middle")
        self.line(axis.start, y, axis.end, y, "axis")

    def up(self, axis: Axis, left: float, right: float, ticks: Mapping[float, str]) -> None:
        """Add the ticks of a vertical axis, value -> text, with grid lines from ``left`` to ``right``."""
        for value, text in ticks.items():
            self.line(left, axis(value), right, axis(value), "grid")
            self.text(left - 6, axis(value) + 4, text, "tick", "end")

    def heading(self, y: float, right: float, name: str, numbers: str, css: str) -> None:
        """Add a name on the left, cut where it would reach the numbers that stand on the right."""
        self.text(0, y, shorten(name, self.width - len(numbers) * 6.2 - 20), css)
        self.text(right, y, numbers, "tick halo", "end")

    def legend(self, named: Mapping[str, str]) -> None:
        """Add a line at the top that says which colour a variant has, name -> class; names share the width."""
        x, room = 0.0, self.width / max(1, len(named)) - 40
        for name, css in named.items():
            shown = shorten(name, min(150.0, room / 7 * CHARACTER))
            self.add("circle", f"dot {css}", cx=x + 5, cy=9, r=4)
            self.text(x + 15, 13, shown, "name")
            x += 34 + 7 * len(shown)

    def svg(self) -> str:
        """Return the drawing."""
        top = (
            f'<svg role="img" viewBox="0 0 {self.width} {self.height}" width="{self.width}" height="{self.height}" '
            f'aria-labelledby="{self._key}-t {self._key}-d" class="chart">'
        )
        return "\n".join([top, *self._parts, "</svg>"])


def _safe(value: str | float) -> str:
    return escape(plain(value)) if isinstance(value, str) else f"{value:.1f}".removesuffix(".0")
