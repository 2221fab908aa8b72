"""GIF, by Pillow: 256 colours, what does not change from picture to picture is not stored again."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import require, require_present
from vlatool.files.user_files import stamp_of
from vlatool.render.video import HOLD_S, Picture, Video

EXTRA = "video"
FASTEST_HZ = 50.0
"""Pictures a second that viewers show: a delay of less than 2/100 s is one of 10/100 s to them."""
ATTEMPTS = ((240, 1), (64, 1), (24, 1), (24, 2), (24, 4))
"""Colours, and the share of the pictures that is left out, until the file is small enough."""
PICTURE_BYTES, LEAST_BYTES = 15_000, 1_000_000
"""Small enough: 3 MB for 200 pictures."""
SAMPLED_PICTURES, SAMPLED_PIXELS = 12, 1_000_000
"""Pictures, and about how many pixels of each, that the colours are chosen from."""
CLEAR = 255
"""The index that stands for what was there before."""


class Gif:
    """Writes an animated GIF that is shown again and again."""

    def check(self) -> None:
        """Refuse to begin without Pillow; raises MissingExtra when it is not installed."""
        require_present("PIL", EXTRA)

    def write(self, video: Video, draft: Path) -> str:
        """Write a video into a new file; return what was left out of it, in a few words."""
        image = require("PIL.Image", EXTRA)
        least = int(-(-video.hz // FASTEST_HZ)) or 1
        every = least
        for colours, share in ATTEMPTS:
            every = least * share
            _write(image, video, draft, colours, every)
            if draft.stat().st_size <= max(LEAST_BYTES, PICTURE_BYTES * video.count):
                break
        return f"one in {every} pictures" if every > 1 else ""


@dataclass
class _Patch:
    """What changes from one picture to the next."""

    indices: NDArray[np.uint8]
    left: int
    top: int
    start: int
    """When it is shown, in 1/100 s."""


def _write(image: Any, video: Video, draft: Path, colours: int, every: int) -> None:
    palette = _palette(image, video, colours)
    with draft.open("wb") as file:
        patches = _patches(image, video, palette, every)
        before = next(patches)
        height, width = before.indices.shape
        file.write(_head(width, height, palette.getpalette()))
        for patch in patches:
            file.write(_frame(image, before, patch.start - before.start))
            before = patch
        end = round(100 * video.count / video.hz) + round(100 * HOLD_S)
        file.write(_frame(image, before, end - before.start))
        file.write(b"\x21\xfe\x71\n")  # a comment of 113 bytes, the line feed among them
    with draft.open("ab") as file:
        file.write(stamp_of(draft.read_bytes()) + b"\x00;")


def _head(width: int, height: int, palette: list[int]) -> bytes:
    """Return the header, the table of colours, and the word that begins the video anew at its end."""
    table = bytes(palette).ljust(768, b"\0")[:768]
    return (
        b"GIF89a" + struct.pack("<HHBBB", width, height, 0xF7, 0, 0) + table + b"\x21\xff\x0bNETSCAPE2.0\x03\x01\0\0\0"
    )


def _palette(image: Any, video: Video, colours: int) -> Any:
    """Return a picture whose palette has the inks, and the colours that the pictures need most."""
    wanted = set(np.linspace(0, video.count - 1, min(SAMPLED_PICTURES, video.count)).round().astype(int).tolist())
    samples = [_thinned(picture) for index, picture in enumerate(video.pictures()) if index in wanted]
    needed = image.fromarray(np.concatenate(samples)).quantize(colours, image.Quantize.MEDIANCUT)
    found = needed.getpalette()[: 3 * len(needed.getcolors())]
    palette = image.new("P", (1, 1))
    palette.putpalette([*(part for ink in video.inks for part in ink), *found][: 3 * CLEAR])
    return palette


def _thinned(picture: Picture) -> Picture:
    step = int((picture.shape[0] * picture.shape[1] / SAMPLED_PIXELS) ** 0.5) + 1
    return picture[::step, ::step]


def _patches(image: Any, video: Video, palette: Any, every: int) -> Iterator[_Patch]:
    """Yield the first picture whole, and then what changes, at the moments at which it does."""
    before: NDArray[np.uint8] | None = None
    for index, picture in enumerate(video.pictures()):
        if index % every and index != video.count - 1:
            continue
        indices = np.asarray(image.fromarray(picture).quantize(palette=palette, dither=image.Dither.NONE))
        start = round(100 * -(-index // every) * every / video.hz)
        if before is None:
            yield _Patch(indices, 0, 0, start)
        elif (changed := indices != before).any():
            rows, columns = (np.flatnonzero(changed.any(axis=axis)) for axis in (1, 0))
            box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
            fresh = np.where(changed[box], indices[box], CLEAR).astype(np.uint8)
            yield _Patch(fresh, int(columns[0]), int(rows[0]), start)
        before = indices


def _frame(image: Any, patch: _Patch, delay: int) -> bytes:
    """Return a patch that is shown for some 1/100 s, on top of what was there."""
    control = b"\x21\xf9\x04" + struct.pack("<BHBB", 0x05, min(delay, 0xFFFF), CLEAR, 0)
    indices = image.fromarray(np.ascontiguousarray(patch.indices)).convert("L")
    data = require("PIL.GifImagePlugin", EXTRA).getdata(indices, (patch.left, patch.top))
    return control + b"".join(data)
