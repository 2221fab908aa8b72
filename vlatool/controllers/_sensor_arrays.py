"""Messages of sensors as arrays, with a sentence instead of an error: a controller never raises for what arrives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import BusError
from vlatool.messages import clouds, pixels
from vlatool.messages.sensor_msgs import Image, LaserScan, PointCloud2

Array = NDArray[Any]


def colours_of(message: Image | None) -> tuple[Array | None, str]:
    """Return an image as uint8 (H, W, 3), red first, or None and what is wrong with it."""
    if message is None:
        return None, "no image"
    try:
        return pixels.rgb(message), ""
    except BusError as error:
        return None, error.message


def depth_of(message: Image | None) -> tuple[Array | None, str]:
    """Return depths in metres, float32 (H, W), NaN where unknown, or None and what is wrong with the message."""
    if message is None:
        return None, "no depth image"
    try:
        return pixels.depth_m(message), ""
    except BusError as error:
        return None, error.message


def thin_depth_of(message: Image | None, stride: int) -> tuple[Array | None, tuple[int, int], str]:
    """Return depths of every so many rows and columns, the size (H, W) of the whole image, and what is wrong with it.

    The first is that at half a stride; otherwise as ``depth_of``.
    """
    if message is None:
        return None, (0, 0), "no depth image"
    try:
        whole = pixels.image(message)
        part = whole[stride // 2 :: stride, stride // 2 :: stride]
        if message.encoding in pixels.DEPTHS and part.size:
            message = pixels.image_message(part, message.encoding)
        return pixels.depth_m(message), whole.shape[:2], ""
    except BusError as error:
        return None, (0, 0), error.message


def points_of(message: PointCloud2 | None) -> tuple[Array | None, str]:
    """Return the finite points of a cloud, float64 (N, 3) in metres, or None and what is wrong with the message."""
    if message is None:
        return None, "no cloud"
    try:
        return clouds.points(message).astype(np.float64), ""
    except BusError as error:
        return None, error.message


def rays_of(message: LaserScan | None) -> tuple[Array, Array]:
    """Return angles and ranges of a scan, each float64 (N,): inf where nothing is in reach, NaN where unknown.

    Where its limits leave no range, as in a message whose driver did not set them, all are unknown.
    """
    if message is None:
        return np.zeros(0), np.zeros(0)
    ranges = np.asarray(message.ranges, np.float64)
    angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
    known = (ranges >= message.range_min) & ~(ranges < 0)
    far = ranges > message.range_max
    if message.range_max <= max(message.range_min, 0.0):
        return angles, np.full(len(ranges), np.nan)
    return angles, np.where(far, np.inf, np.where(known, ranges, np.nan))
