"""Names of points in a chart: beside them, at the end of a line where points are close, else numbers and a legend."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from vlatool.render.charts.svg import CHARACTER, Canvas, shorten

Box = tuple[float, float, float, float]
CHARACTER_WIDTH = CHARACTER + 0.9
ROW, ROWS = 17.0, 9
REACHES = (13.0, 42.0)
CLOSE = 17.0
LEGEND_ROW = 16.0


@dataclass(frozen=True)
class Mark:
    """A point that is to be named: where it is, in pixels, and the class of its colour."""

    x: float
    y: float
    name: str
    css: str
    size: float = 8.0

    @property
    def box(self) -> Box:
        """What it covers."""
        return self.x - self.size, self.y - self.size, self.x + self.size, self.y + self.size


@dataclass(frozen=True)
class Label:
    """A text at a place, and whether a line leads to it from its point."""

    mark: Mark
    text: str
    x: float
    y: float
    anchor: str
    led: bool

    @property
    def box(self) -> Box:
        """What it covers."""
        wide = len(self.text) * CHARACTER_WIDTH
        start = self.x if self.anchor == "start" else self.x - wide
        return start, self.y - 11, start + wide, self.y + 4

    @property
    def end(self) -> tuple[float, float]:
        """Where the line to it ends."""
        return self.x + (-3 if self.anchor == "start" else 3), self.y - 4

    def way(self) -> list[Box]:
        """Return small boxes along the line to it."""
        if not self.led:
            return []
        ends = ((self.mark.x, self.end[0]), (self.mark.y, self.end[1]))
        spots = [[start + share / 8 * (end - start) for start, end in ends] for share in range(1, 9)]
        return [(x - 1, y - 1, x + 1, y + 1) for x, y in spots]


@dataclass(frozen=True)
class Labels:
    """All labels of a chart, and the names that a legend below explains by their numbers; empty without a legend."""

    labels: tuple[Label, ...]
    legend: tuple[Mark, ...] = ()

    @property
    def height(self) -> float:
        """Pixels that the legend takes below the chart."""
        return LEGEND_ROW * len(self.legend) + 6 if self.legend else 0.0

    def draw(self, canvas: Canvas, below: float) -> None:
        """Draw lines, labels, and the legend below ``below``."""
        for label in self.labels:
            if label.led:
                canvas.line(label.mark.x, label.mark.y, *label.end, f"leader {label.mark.css}")
        for label in self.labels:
            canvas.text(label.x, label.y, label.text, f"name halo ink {label.mark.css}", label.anchor)
        for number, mark in enumerate(self.legend, 1):
            name = f"{number} {shorten(mark.name, canvas.width * 0.9)}"
            canvas.text(4, below + 8 + LEGEND_ROW * number - 6, name, f"name ink {mark.css}")


def labels(marks: Sequence[Mark], frame: Box, taken: Sequence[Box], longest: float) -> Labels:
    """Return where the names of points stand, so that none covers another one, a point, or what is taken.

    Args:
        frame: Pixels inside which labels stay: left, top, right, bottom.
        taken: Boxes of what else stands in the chart.
        longest: Pixels that a name may take.
    """
    named = _placed(marks, [shorten(mark.name, longest) for mark in marks], frame, taken)
    if named is not None:
        return Labels(named)
    numbers = _placed(marks, [str(number) for number, _ in enumerate(marks, 1)], frame, taken)
    return Labels(numbers or (), tuple(marks))


def _placed(marks: Sequence[Mark], texts: Sequence[str], frame: Box, taken: Sequence[Box]) -> tuple[Label, ...] | None:
    """Return a label for each mark, None when there is no room for one of them."""
    points = [mark.box for mark in marks]
    placed: list[Label] = []
    for mark, text in zip(marks, texts, strict=True):
        crowded = any(other is not mark and _distance(mark, other) < CLOSE for other in marks)
        covered = [*points, *taken, *(box for label in placed for box in (label.box, *label.way()))]
        texts_of = [label.box for label in placed]
        for label in _candidates(mark, text, crowded):
            if _inside(label.box, frame) and not _meets([label.box], covered) and not _meets(label.way(), texts_of):
                placed.append(label)
                break
        else:
            return None
    return tuple(placed)


def _candidates(mark: Mark, text: str, crowded: bool) -> Iterator[Label]:
    """Return places for a label, the nearest first."""
    for reach in REACHES:
        for row in sorted(range(-ROWS, ROWS + 1), key=abs):
            led = crowded or abs(row) > 1 or reach > REACHES[0]
            yield Label(mark, text, mark.x + reach, mark.y + 4 + row * ROW, "start", led)
            yield Label(mark, text, mark.x - reach, mark.y + 4 + row * ROW, "end", led)


def _distance(one: Mark, other: Mark) -> float:
    return max(abs(one.x - other.x), abs(one.y - other.y))


def _inside(box: Box, frame: Box) -> bool:
    return box[0] >= frame[0] and box[1] >= frame[1] and box[2] <= frame[2] and box[3] <= frame[3]


def _meets(some: Sequence[Box], others: Sequence[Box]) -> bool:
    return any(
        one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
        for one in some for other in others
    )  # fmt: skip
