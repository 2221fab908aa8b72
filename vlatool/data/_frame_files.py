"""One camera frame in a file, and a picture of what a network sees of it: ``vlatool inspect --frame``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.image import LAYOUTS, ORDERS, Image
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError, require
from vlatool.files.limits import check_limit
from vlatool.files.printable import message_of
from vlatool.files.user_files import atomic_file, refuse_file, stamp_of
from vlatool.runtime.image import as_rgb

Array = NDArray[Any]
EXTRA = "video"
FORMS = "a picture (PNG, JPEG), or .npy with a frame as the camera gives it"
GAP = 8
"""Pixels between two pictures beside each other."""


def read_frame(path: Path, order: str) -> Array:
    """Return a frame as a camera with channels in ``order`` gives it: what ``.npy`` holds, or a picture in that order.

    Raises:
        DataError: when the file cannot be read, or is larger than the limit ``elements``.
        MissingExtra: when a picture needs Pillow, which is not installed.
    """
    try:
        if path.suffix == ".npy":
            stored = np.load(path, mmap_mode="r", allow_pickle=False)
            check_limit("elements", stored.size, str(path), DataError)
            return np.array(stored)
        return _read_picture(path, order)
    except (OSError, ValueError, EOFError, SyntaxError) as error:  # Pillow raises SyntaxError for a broken PNG
        raise DataError(f"The frame {path} cannot be read: {message_of(error)}.", f"give {FORMS}") from error


def _read_picture(path: Path, order: str) -> Array:
    pillow = require("PIL.Image", EXTRA)
    try:
        with pillow.open(path) as picture:
            check_limit("elements", 4 * picture.width * picture.height, str(path), DataError)
            mode = {1: "L", 3: "RGB", 4: "RGBA"}[ORDERS[order]]
            pixels = np.asarray(picture.convert(mode))
    except pillow.DecompressionBombError as error:
        raise DataError(f"The frame {path} is too large: {message_of(error)}.", "give a frame of a camera") from error
    return pixels if order == "grey" else pixels[:, :, ["rgba".index(channel) for channel in order]]


def picture_of(tensor: TensorSpec, image: Image, encoded: Array) -> Array:
    """Return what a network is given, uint8 (H, W, 3), with its range, mean and std undone."""
    channels = ORDERS[image.channels]
    axes = encoded.reshape(encoded.shape[-LAYOUTS[image.layout] :])
    picture = axes[:, :, None] if image.layout == "hw" else np.moveaxis(axes, image.layout.index("c"), 2)
    values = picture.astype(np.float64)
    if tensor.dtype != "uint8":
        std, mean = (np.broadcast_to(numbers or (default,), channels)
                     for numbers, default in ((image.std, 1.0), (image.mean, 0.0)))  # fmt: skip
        low, high = image.range
        values = (values * std + mean - low) / (high - low) * 255
    return np.asarray(as_rgb(np.clip(np.rint(values), 0, 255).astype(np.uint8), image.channels))


def write_beside(path: Path, frame: Array, seen: Array, *, force: bool) -> None:
    """Write a PNG of a frame, (H, W, 3), with what the network sees beside it.

    Raises:
        DataError: when the file is not named ``.png``.
        OutputError: when it exists, and is not to be replaced.
    """
    if path.suffix.lower() != ".png":
        raise DataError(f"The picture {path} must be a PNG.", "name a file that ends in .png")
    refuse_file(path, force=force)
    height, width = max(len(frame), len(seen)), frame.shape[1] + GAP + seen.shape[1]
    canvas = np.full((height, width, 3), 255, np.uint8)
    canvas[: len(frame), : frame.shape[1]] = frame
    canvas[: len(seen), -seen.shape[1] :] = seen
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as draft:
        require("PIL.Image", EXTRA).fromarray(canvas).save(draft, format="PNG")
        content = draft.read_bytes() + b"\n"
        draft.write_bytes(content + stamp_of(content))
