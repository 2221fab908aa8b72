"""Compressed pictures of recordings, decoded by Pillow once their header says that they are not too large."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError, VlatoolError, require
from vlatool.files.limits import check_limit

Array = NDArray[Any]
RECORD_AGAIN = "record it again, or leave the episode out"
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
PICTURE_MODES = ("L", "RGB", "RGBA", "I;16", "I", "F")
"""Modes of Pillow whose values are handed on; others become RGB."""
LIBRARY_ERRORS = (
    OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, NotImplementedError, RuntimeError,
    SyntaxError, OverflowError, EOFError, MemoryError, AssertionError, struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip
"""What libraries raise on damaged files."""


@contextmanager
def library_errors(where: str, fix: str = RECORD_AGAIN) -> Iterator[None]:
    """Turn what a library raises on a damaged file into an error of one sentence.

    Raises:
        DataError: for what is in ``LIBRARY_ERRORS``.
    """
    try:
        yield
    except VlatoolError:
        raise
    except LIBRARY_ERRORS as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"{where} cannot be read: {reason.rstrip('.')}.", fix) from error


def decode_picture(content: bytes, where: str) -> Array:
    """Return a compressed picture as (height, width, channels), in the values that are stored.

    Raises:
        DataError: when it is corrupt, or larger than the limit ``picture_bytes``.
        MissingExtra: when Pillow is not installed.
    """
    library: Any = require("PIL.Image", "data")
    with library_errors(where):
        if not content:
            raise DataError(f"{where} is empty.", RECORD_AGAIN)
        library.MAX_IMAGE_PIXELS = None  # the limit below is in its place
        with library.open(io.BytesIO(content)) as picture:
            check_limit("picture_bytes", picture.width * picture.height * 4, where, DataError)
            picture.load()
            values = np.asarray(picture if picture.mode in PICTURE_MODES else picture.convert("RGB"))
    return values if values.ndim == 3 else values[:, :, None]


def stack_pictures(pictures: Sequence[Array], where: str, rows: Sequence[int] | NDArray[np.intp]) -> Array:
    """Return pictures as one array, (n, height, width, channels).

    Args:
        where: their column in messages.
        rows: (n,) the row of each.

    Raises:
        DataError: when they differ in size or type.
    """
    first = pictures[0]
    for row, picture in zip(rows, pictures, strict=True):
        if (picture.shape, picture.dtype) != (first.shape, first.dtype):
            raise DataError(
                f"{where} is {picture.dtype} {list(picture.shape)} in sample {int(row)}, and {first.dtype} "
                f"{list(first.shape)} in sample {int(rows[0])}.",
                "record each camera in one size",
            )
    return np.stack(pictures)
