"""Laser scans as NumPy arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import BusError
from vlatool.messages.sensor_msgs import LaserScan

Array = NDArray[Any]


def ranges_m(message: LaserScan) -> Array:
    """Return the ranges, (N,) float32 in metres, NaN where none was measured.

    That is NaN, infinity, and what is outside ``range_min`` to ``range_max`` (REP-117: +inf is beyond the reach of the
    sensor, -inf too near to measure).
    """
    ranges = np.array(message.ranges, np.float32)
    with np.errstate(invalid="ignore"):
        measured = np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max)
    ranges[~measured] = np.nan
    return ranges


def angles(message: LaserScan) -> Array:
    """Return the angle of each range, (N,) float64 in radians, counter-clockwise from the x axis of the frame.

    Raises:
        BusError: when the first angle or the increment is NaN or infinite.
    """
    first, increment = float(message.angle_min), float(message.angle_increment)
    if not (math.isfinite(first) and math.isfinite(increment)):
        raise BusError(
            f"A laser scan with angle_min {first} and angle_increment {increment}.", "check the driver of the lidar"
        )
    return first + increment * np.arange(len(message.ranges), dtype=np.float64)
