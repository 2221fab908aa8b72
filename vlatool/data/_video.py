"""Frames of a video by time stamp, decoded by PyAV in order wherever frames are asked for in order."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from vlatool.data._pictures import LIBRARY_ERRORS, RECORD_AGAIN
from vlatool.errors import DataError, VlatoolError, require
from vlatool.files.limits import check_limit

Array = NDArray[Any]
MAX_SKIP_S = 2.0
"""Seconds of a video that are decoded and skipped, rather than sought."""


class VideoFrames:
    """Decodes frames of videos, one video at a time.

    Args:
        tolerance: seconds that a frame may be from the time that is asked for.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._file: Path | None = None
        self._container: Any = None
        self._frames: Iterator[Any] = iter(())
        self._last: Any = None

    def at(self, file: Path, time: float) -> Array:
        """Return the frame at a time in seconds, (height, width, 3) RGB.

        Raises:
            DataError: when the video is missing or corrupt, or has no frame at that time.
            MissingExtra: when PyAV is not installed.
        """
        try:
            frame = self._find(file, time)
            if frame is None or abs(float(frame.time) - time) > self._tolerance:
                nearest = "it ends before" if frame is None else f"the next one is at {float(frame.time):.3f} s"
                raise DataError(f"{file} has no frame at {time:.3f} s: {nearest}.", RECORD_AGAIN)
            pixels: Array = frame.to_ndarray(format="rgb24")
            return pixels
        except VlatoolError:
            self._close()
            raise
        except LIBRARY_ERRORS as error:  # those of PyAV are subclasses
            self._close()
            raise DataError(f"{file} cannot be read: {str(error)[:200]}.", RECORD_AGAIN) from error

    def shape(self, file: Path) -> tuple[int, int, int]:
        """Return the shape of a video's frames.

        Raises:
            DataError: when it cannot be read.
        """
        try:
            context = self._open(file).codec_context
            return int(context.height), int(context.width), 3
        except VlatoolError:
            raise
        except LIBRARY_ERRORS as error:
            raise DataError(f"{file} cannot be read: {str(error)[:200]}.", RECORD_AGAIN) from error

    def _find(self, file: Path, time: float) -> Any:
        """Return the first frame from a time on; None behind the last one."""
        stream = self._open(file)
        last = None if self._last is None else float(self._last.time)
        if last is not None and abs(last - time) <= self._tolerance:
            return self._last
        if last is None or not last < time < last + MAX_SKIP_S:
            start = max(0, round(max(0.0, time - self._tolerance) / stream.time_base))
            self._container.seek(start, stream=stream)
            self._frames = self._container.decode(stream)
        reached = (frame for frame in self._frames if frame.time is not None and frame.time >= time - self._tolerance)
        self._last = next(reached, None)
        return self._last

    def _open(self, file: Path) -> Any:
        if self._file != file:
            self._close()
            library: Any = require("av", "data")
            if not file.is_file():
                raise DataError(f"{file} not found.", "copy the dataset again, with its videos")
            self._container, self._file = library.open(str(file)), file
            if not self._container.streams.video:
                raise DataError(f"{file} holds no video.", RECORD_AGAIN)
            context = self._container.streams.video[0].codec_context
            context.thread_count = 1
            check_limit("picture_bytes", context.width * context.height * 4, str(file), DataError)
        return self._container.streams.video[0]

    def _close(self) -> None:
        if self._container is not None:
            self._container.close()
        self._file = self._container = self._last = None
        self._frames = iter(())
