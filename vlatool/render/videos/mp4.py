"""MP4, by ffmpeg: the one on PATH, or that of the package imageio-ffmpeg."""

from __future__ import annotations

import contextlib
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, cast

import numpy as np

from vlatool.errors import MissingExtra, OutputError, pip_install, require, require_present
from vlatool.files.user_files import stamp_of
from vlatool.render.video import HOLD_S, Picture, Video

EXTRA = "mp4"
CODECS = (("-c:v", "libx264", "-crf", "18"), ("-c:v", "mpeg4", "-q:v", "3"))
"""Tried one after the other: H.264, which an ffmpeg may lack, and MPEG-4."""
MAX_MESSAGE = 300
"""Characters of what ffmpeg says that are shown."""


class Mp4:
    """Writes H.264 in an MP4 file."""

    def check(self) -> None:
        """Refuse to begin without ffmpeg, or Pillow, which writes on the pictures; raises MissingExtra."""
        require_present("PIL", EXTRA)
        program()

    def write(self, video: Video, draft: Path) -> str:
        """Write a video into a new file; raises OutputError when ffmpeg fails."""
        for codec in CODECS:
            said = _encoded(video, draft, codec)
            if not said:
                break
        else:
            raise OutputError(f"ffmpeg could not write the video: {said}.", "write a .gif")
        with draft.open("ab") as file:
            file.write(struct.pack(">I", 8 + 1 + 112) + b"free\n")  # a box that players pass over
        with draft.open("ab") as file:
            file.write(stamp_of(draft.read_bytes()))
        return ""


def program() -> str:
    """Return the path of ffmpeg; raises MissingExtra when there is none."""
    if found := shutil.which("ffmpeg"):
        return found
    with contextlib.suppress(MissingExtra, RuntimeError):
        return str(require("imageio_ffmpeg", EXTRA).get_ffmpeg_exe())
    raise MissingExtra(
        "An mp4 needs ffmpeg, and there is none on PATH; the extra 'mp4' provides one. A .gif needs the extra 'video'.",
        pip_install(EXTRA),
    )


def _encoded(video: Video, draft: Path, codec: tuple[str, ...]) -> str:
    """Encode a video; return what ffmpeg says when it fails, and nothing when it does not."""
    pictures = video.pictures()
    first = _even(next(pictures))
    size = f"{first.shape[1]}x{first.shape[0]}"
    given = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{video.hz:.6g}", "-i", "-")
    made = (*codec, "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(draft.absolute()))
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen(
            [program(), "-y", "-loglevel", "error", *given, *made],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=told,
        )  # fmt: skip
        try:
            _feed(cast("IO[bytes]", process.stdin), first, pictures, round(HOLD_S * video.hz))
        except BaseException:
            process.kill()
            raise
        finally:
            process.wait()
        told.seek(0)
        said = " ".join(told.read().decode("utf-8", "replace").split())
    return (said[:MAX_MESSAGE] or f"exit code {process.returncode}") if process.returncode else ""


def _feed(stream: IO[bytes], first: Picture, rest: Iterator[Picture], hold: int) -> None:
    """Hand all pictures to ffmpeg, the last one as often as it is held; how an end before that came, it says itself."""
    with contextlib.suppress(BrokenPipeError), stream:
        last = first
        stream.write(last.tobytes())
        for picture in rest:
            last = _even(picture)
            stream.write(last.tobytes())
        for _ in range(hold):
            stream.write(last.tobytes())


def _even(picture: Picture) -> Picture:
    """Return a picture of even sides, the last row or column twice where they are not."""
    return np.pad(picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), mode="edge")
