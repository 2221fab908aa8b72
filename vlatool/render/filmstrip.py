"""One episode of several variants beside each other, picture by picture, with a caption: what a video shows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.errors import require
from vlatool.render._format import fixed_decimals, plain
from vlatool.render.video import Picture, Video

EXTRA = "video"
PAPER, INK, MUTED_INK, GOOD, BAD = (20, 23, 26), (231, 233, 236), (140, 148, 156), (111, 211, 155), (255, 139, 152)
TINTS = ((155, 164, 173), (107, 184, 247))
"""Of the baseline and of the variant, as in the report; of a variant alone, the second."""
AHEAD_INK = (70, 76, 83)
"""Of the steps that are still to come."""
INKS = (PAPER, INK, MUTED_INK, GOOD, BAD, AHEAD_INK, *TINTS)
PICTURE_HEIGHT, MAX_PICTURE_WIDTH = 192, 640
"""Pixels that a picture has in height, by a whole factor, unless it gets wider than the second."""
EDGE, GAP, LINE, BAR = 8, 12, 16, 10
"""Pixels around all, between the variants, of a line of text and of the bar of steps."""
TEXT = 12


@dataclass(frozen=True)
class Shot:
    """The episode of one variant.

    Args:
        pictures: Pictures of the reset and after each step, uint8 (H, W, 3); iterated more than once.
        count: Number of the pictures.
        size: Height and width of each.
        steps: Steps of the whole episode, which may be longer than what was filmed.
        success: How it ended.
        seams: Steps, from 1, at which a new chunk begins; none where each step does.
    """

    variant: str
    pictures: Iterable[Picture]
    count: int
    size: tuple[int, int]
    steps: int
    success: bool
    seams: tuple[int, ...] = ()

    @property
    def factor(self) -> int:
        """How many times larger the pictures are shown."""
        height, width = self.size
        return max(1, min(-(-PICTURE_HEIGHT // height), MAX_PICTURE_WIDTH // width))


def filmstrip(shots: Sequence[Shot], title: str, hz: float) -> Video:
    """Return the video of an episode; a variant that is done first stands still at its end.

    Args:
        shots: The baseline first, when there are two.
        title: Which episode it is: task and seed.
        hz: Control rate.
    """
    count = max(shot.count for shot in shots)
    return Video(lambda: _composed(shots, title, count), count, hz, INKS)


def _composed(shots: Sequence[Shot], title: str, count: int) -> Iterator[Picture]:
    panels = [_Panel(shot, tint) for shot, tint in zip(shots, TINTS[-len(shots) :], strict=True)]
    height = max(panel.height for panel in panels)
    width = sum(panel.width for panel in panels) + GAP * (len(panels) - 1)
    pen = _Pen()
    for step in range(count):
        sheet = np.full((height + LINE + 2 * EDGE, width + 2 * EDGE, 3), PAPER, np.uint8)
        corner = EDGE
        for panel in panels:
            panel.draw(sheet, step, EDGE + LINE, corner)
            corner += panel.width + GAP
        pen.begin(sheet)
        pen.write(EDGE, EDGE, title, MUTED_INK, width)
        corner = EDGE
        for panel in panels:
            panel.caption(pen, step, EDGE + LINE, corner)
            corner += panel.width + GAP
        yield pen.end()


class _Panel:
    """One variant: a line of text, its picture, a bar of its steps."""

    def __init__(self, shot: Shot, tint: tuple[int, int, int]) -> None:
        self._shot, self._tint = shot, tint
        self._pictures = iter(shot.pictures)
        self._last: Picture = np.zeros((1, 1, 3), np.uint8)
        self.width = max(PICTURE_HEIGHT, shot.size[1] * shot.factor)
        self.height = LINE + shot.size[0] * shot.factor + BAR

    def draw(self, sheet: Picture, step: int, top: int, left: int) -> None:
        """Put the picture of a step on the sheet, and below it the bar."""
        shot = self._shot
        if step < shot.count:
            self._last = next(self._pictures).repeat(shot.factor, 0).repeat(shot.factor, 1)
        height, width = self._last.shape[:2]
        sheet[top + LINE : top + LINE + height, left : left + width] = self._last
        middle = top + LINE + height + BAR // 2 + 1
        reached = left + round(self.width * min(step, shot.steps) / max(1, shot.steps))
        sheet[middle - 1 : middle + 1, left : left + self.width] = AHEAD_INK
        sheet[middle - 1 : middle + 1, left:reached] = self._tint
        for seam in shot.seams:
            at = left + round((self.width - 1) * (seam - 1) / max(1, shot.steps))
            sheet[middle - 4 : middle + 4, at] = self._tint if seam <= step else AHEAD_INK

    def caption(self, pen: _Pen, step: int, top: int, left: int) -> None:
        """Write whose picture it is, and how far the episode is or how it ended."""
        shot, done = self._shot, min(step, self._shot.count - 1)
        where, colour = f"step {fixed_decimals(done, 0)}", INK
        if done >= shot.steps:
            where, colour = ("success", GOOD) if shot.success else ("failure", BAD)
            where = f"{where} at step {fixed_decimals(shot.steps, 0)}"
        elif step > done or done == shot.count - 1 > 0:
            where, colour = f"step {fixed_decimals(done, 0)}, not filmed further", MUTED_INK
        elif step in shot.seams:
            where = f"{where}, new chunk"
        room = pen.write(left + self.width, top, where, colour, self.width, right=True)
        pen.write(left, top, plain(shot.variant), self._tint, self.width - room - GAP)


class _Pen:
    """Writes on a sheet."""

    def __init__(self) -> None:
        self._image, self._draw = require("PIL.Image", EXTRA), require("PIL.ImageDraw", EXTRA)
        self._font = require("PIL.ImageFont", EXTRA).load_default(TEXT)
        self._lengths: dict[str, int] = {}
        self._sheet: Any = None
        self._lines: Any = None

    def begin(self, sheet: Picture) -> None:
        """Take a sheet."""
        self._sheet = self._image.fromarray(sheet)
        self._lines = self._draw.Draw(self._sheet)
        self._lines.fontmode = "1"  # without shades between ink and paper, which a format with few colours lacks

    def write(self, x: int, y: int, text: str, colour: tuple[int, int, int], width: int, *, right: bool = False) -> int:
        """Write a text, cut where it is wider than it may be; return its width.

        Args:
            x, y: Its left end, or its right one, and its top.
            text: One line.
            width: Largest width in pixels.
            right: Whether it ends at ``x``.
        """
        if self._length(text) > width:
            fits = (f"{text[:most]}…" for most in range(min(len(text), width), 0, -1))
            text = next((cut for cut in fits if self._length(cut) <= width), "")
        long = self._length(text)
        self._lines.text((x - long if right else x, y), text, fill=colour, font=self._font)
        return long

    def _length(self, text: str) -> int:
        """Return how wide a text is in pixels: without shades, letters stand further apart than the font says."""
        if text not in self._lengths:
            sheet = self._image.new("1", (2 * round(self._font.getlength(text)) + TEXT, 2 * TEXT))
            self._draw.Draw(sheet).text((0, 0), text, fill=1, font=self._font)
            self._lengths[text] = (sheet.getbbox() or (0, 0, 0, 0))[2]
        return self._lengths[text]

    def end(self) -> Picture:
        """Return the sheet."""
        return np.asarray(self._sheet)
