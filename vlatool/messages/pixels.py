"""Images as NumPy arrays and back: the encodings of ``sensor_msgs/image_encodings.h``, colours, depth in metres."""

from __future__ import annotations

import re
import sys
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import BusError
from vlatool.messages._colours import BAYER_PATTERNS, demosaic, rgb_of_yuv422
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import Header

Array = NDArray[Any]
MILLIMETRE = np.float32(0.001)


class Encoding(NamedTuple):
    """What the bytes of an image are.

    Args:
        dtype: NumPy's name of the type of an element.
        channels: Elements of a pixel.
    """

    dtype: str
    channels: int


COLOURS = {
    "rgb8": Encoding("uint8", 3), "bgr8": Encoding("uint8", 3), "rgba8": Encoding("uint8", 4),
    "bgra8": Encoding("uint8", 4), "rgb16": Encoding("uint16", 3), "bgr16": Encoding("uint16", 3),
    "rgba16": Encoding("uint16", 4), "bgra16": Encoding("uint16", 4), "mono8": Encoding("uint8", 1),
    "mono16": Encoding("uint16", 1),
}  # fmt: skip
YUV422 = ("yuv422", "uyvy", "yuv422_yuy2", "yuyv")
"""Two pixels in four bytes: U Y V Y for the first two, Y U Y V for the others."""
ENCODINGS = {
    **COLOURS,
    **{name: Encoding("uint8", 2) for name in YUV422},
    **{f"bayer_{pattern}{bits}": Encoding(f"uint{bits}", 1) for pattern in BAYER_PATTERNS for bits in (8, 16)},
}
GENERIC = re.compile(r"(8|16|32|64)([USF])C([1-9][0-9]{0,2})?")
"""An encoding as OpenCV names it: bits, kind of number, channels."""
KINDS = {"U": "uint", "S": "int", "F": "float"}
GENERIC_COLOURS = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8"}
"""Generic encoding -> the one that it is taken for where colours are wanted, as OpenCV orders them."""
DEPTHS = {"16UC1": MILLIMETRE, "mono16": MILLIMETRE, "32FC1": np.float32(1.0), "64FC1": np.float32(1.0)}
"""Encoding of a depth image -> metres of its unit (REP-118)."""


def encoding_of(message: Image) -> Encoding:
    """Return what the bytes of an image are.

    Raises:
        BusError: for an unknown encoding.
    """
    name = message.encoding
    if name in ENCODINGS:
        return ENCODINGS[name]
    match = GENERIC.fullmatch(name)
    if match and not (match[1] == "8" and match[2] == "F"):
        try:
            return Encoding(np.dtype(f"{KINDS[match[2]]}{match[1]}").name, int(match[3] or 1))
        except TypeError:
            pass
    raise BusError(
        f"Unknown encoding {name[:40]!r} of an image; known: {', '.join(ENCODINGS)} and, for instance, 16UC1.",
        "set the encoding of the camera's driver, or convert the images with image_proc or cv_bridge",
    )


def image(message: Image) -> Array:
    """Return the pixels as they are, (H, W) or (H, W, C), read-only; a view of the data in native byte order.

    Colours keep the order of the encoding; Bayer images are the mosaic, (H, W); YUV 4:2:2 is (H, W, 2) uint8.

    Raises:
        BusError: for an unknown encoding, an image without pixels, or data that do not fit its size.
    """
    encoding = encoding_of(message)
    dtype = np.dtype(encoding.dtype)
    height, width, step = message.height, message.width, message.step
    row = width * encoding.channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8) if isinstance(message.data, bytes) else message.data
    if not height or not width:
        raise BusError(f"An image of {width} x {height} pixels.", "wait until the camera sends images")
    if step < row or len(data) < (height - 1) * step + row:
        raise BusError(
            f"An image of {width} x {height} pixels in {message.encoding} with rows of {step:,} bytes, {len(data):,} "
            f"bytes in all; a row takes {row:,} bytes, all of them {(height - 1) * max(step, row) + row:,} or more.",
            "check the driver of the camera",
        )
    stored = dtype.newbyteorder(">" if message.is_bigendian else "<")
    shape, strides = (height, width, encoding.channels), (step, encoding.channels * dtype.itemsize, dtype.itemsize)
    pixels: Array = np.ndarray(shape, stored, np.ascontiguousarray(data), strides=strides)
    pixels = pixels.astype(dtype, copy=False)
    pixels.flags.writeable = False
    return pixels[:, :, 0] if encoding.channels == 1 else pixels


def rgb(message: Image) -> Array:
    """Return the colours, (H, W, 3) uint8 in the order red, green, blue; a view of the data for ``rgb8``.

    Grey is repeated; of 16 bits, the upper 8 are taken; alpha is dropped; Bayer mosaics are interpolated bilinearly;
    YUV 4:2:2 is converted by ITU-R BT.601, limited range. ``8UC1`` is taken as grey, ``8UC3`` as ``bgr8`` (OpenCV's).

    Raises:
        BusError: as ``image``, or for an encoding that has no colours.
    """
    pixels, name = image(message), GENERIC_COLOURS.get(message.encoding, message.encoding)
    if name in YUV422:
        if message.width % 2:
            raise BusError(
                f"An image in {name} of {message.width} pixels in a row, which must be even.",
                "look at the camera's driver, or map a topic with another encoding",
            )
        return rgb_of_yuv422(pixels, luma=1 if name in YUV422[:2] else 0)
    if pixels.dtype == np.uint16 and (name in COLOURS or name.startswith("bayer_")):
        pixels = (pixels >> 8).astype(np.uint8)
    if name.startswith("bayer_"):
        return demosaic(pixels, name[len("bayer_") : len("bayer_") + 4])
    if name not in COLOURS:
        raise BusError(
            f"An image in {name}, which has no colours.", "map a topic with a colour image, such as .../color/image_raw"
        )
    if pixels.ndim == 2:
        return np.repeat(pixels[:, :, None], 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, 2::-1]) if name.startswith("bgr") else pixels[:, :, :3]


def depth_m(message: Image) -> Array:
    """Return the depth, (H, W) float32 in metres, NaN where it is unknown: zero, negative, infinite or NaN (REP-118).

    Raises:
        BusError: as ``image``, or for an encoding that is not one of depth.
    """
    if message.encoding not in DEPTHS:
        encoding_of(message)
        raise BusError(
            f"A depth image in {message.encoding}; it must be in 16UC1 (millimetres) or 32FC1 (metres).",
            "map the topic with the depth image, such as .../depth/image_raw",
        )
    pixels = image(message)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = pixels.astype(np.float32) * DEPTHS[message.encoding]
        depth[~((depth > 0) & (depth < np.inf))] = np.nan
    return depth


def image_message(array: Array, encoding: str, header: Header | None = None) -> Image:
    """Return an image from pixels in the encoding that they have; contiguous ones are not copied.

    Args:
        array: (H, W) or (H, W, C) of the dtype of the encoding.
        encoding: ROS's name, such as ``rgb8`` or ``32FC1``.
        header: Moment and frame.

    Raises:
        BusError: for an unknown encoding, or an array of another shape or dtype.
    """
    kind = encoding_of(Image(encoding=encoding))
    pixels = array[:, :, None] if array.ndim == 2 else array
    if pixels.ndim != 3 or pixels.shape[2] != kind.channels or pixels.dtype != np.dtype(kind.dtype):
        raise BusError(
            f"An array {array.shape} of {array.dtype} for an image in {encoding}; it takes (H, W, {kind.channels}) of "
            f"{kind.dtype}.",
            f"convert it, with array.astype(np.{kind.dtype}) for instance, or name the encoding that it has",
        )
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    step = width * kind.channels * pixels.dtype.itemsize
    big = int(sys.byteorder == "big" and pixels.dtype.itemsize > 1)
    return Image(header or Header(), height, width, encoding, big, step, data)
