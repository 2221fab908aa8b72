"""A video: pictures in the order of time, written whole or not at all, in the format that the file's suffix names.

A format is one file in ``videos``, or what another package names in the entry point group ``vlatool.videos``: a class
with ``check()`` and ``write(video, draft)``, and nothing else has to know it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vlatool import registry
from vlatool.errors import OutputError, UsageError, suggest
from vlatool.files.outputs import output_errors
from vlatool.files.ownership import add_to_ledger
from vlatool.files.user_files import atomic_file, refuse_file

Picture = NDArray[np.uint8]
ROOM = 1 << 24
"""Bytes that must be free where a video is written."""
HOLD_S = 2.0
"""How long the last picture stays."""


@dataclass(frozen=True)
class Video:
    """What a format writes.

    Args:
        pictures: Begins anew: yields uint8 (H, W, 3), all of one size.
        count: Number of pictures.
        hz: Pictures a second.
        inks: Colours (R, G, B) of what is written and drawn on pictures, which a format with few colours keeps.
    """

    pictures: Callable[[], Iterator[Picture]]
    count: int
    hz: float
    inks: tuple[tuple[int, int, int], ...] = ()


class Format(Protocol):
    """What a file of ``videos`` defines."""

    def check(self) -> None:
        """Refuse to begin without a package or a program; raises MissingExtra naming it and its extra."""
        ...

    def write(self, video: Video, draft: Path) -> str:
        """Write a video into a new file, ending in a stamp (``files.user_files.stamp_of``); return what it lacks.

        What it lacks is said in a few words (``one in 2 pictures``), and nothing when it lacks nothing.
        """
        ...


def format_of(path: Path) -> Format:
    """Return the format that the suffix of a file names; raises UsageError when it names none."""
    known = registry.names("videos")
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in known:
        said = (
            f"'{suffix}' is none; {suggest(suffix, known)}" if suffix else f"there is none; known: {', '.join(known)}"
        )
        raise UsageError(
            f"{path}: the suffix says what kind of video is written, and {said}.",
            "name a file that ends in .gif or .mp4",
        )
    found: Format = registry.load("videos", suffix)()
    return found


def check_video(path: Path, *, force: bool) -> None:
    """Refuse a video that cannot be written, as far as that is known before there is anything to show.

    Args:
        path: Path of the file; its folder must exist.
        force: Whether a video that vlatool wrote, and nobody changed, may be replaced.

    Raises:
        UsageError: when its suffix names no format.
        MissingExtra: when what writes that format is not installed.
        OutputError: when the folder is missing or may not be written to, the file exists, or the disk is full.
    """
    format_of(path).check()
    folder = path.parent
    if not folder.is_dir():
        raise OutputError(f"Cannot write {path}: there is no folder {folder}.", f"mkdir -p {folder}")
    refuse_file(path, force=force)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"Cannot write {path}: this user may not write to {folder}.", "choose another folder")
    if shutil.disk_usage(folder).free < ROOM:
        raise OutputError(f"Cannot write {path}: the disk is full.", "free some space, or write elsewhere")


def write_video(video: Video, path: Path, *, force: bool = False) -> str:
    """Write a video; the file appears whole or not at all, and not over one that came meanwhile.

    Args:
        force: See ``check_video``.

    Returns:
        What it lacks, in a few words; nothing when it lacks nothing.

    Raises:
        UsageError, MissingExtra: see ``check_video``.
        OutputError: when it cannot be written, the encoder fails, or there is a file that may not be replaced.
        OSError: other errors of the operating system.
    """
    written = format_of(path)
    with output_errors(path):
        with atomic_file(path) as draft:
            lacks = written.write(video, draft)
            refuse_file(path, force=force)
        add_to_ledger(path)
    return lacks
