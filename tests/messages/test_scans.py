"""Laser scans as arrays."""

from __future__ import annotations

import numpy as np
import pytest

from vlatool.errors import BusError
from vlatool.messages.scans import angles, ranges_m
from vlatool.messages.sensor_msgs import LaserScan

NAN = float("nan")


def _scan(ranges: list[float], low: float = 0.1, high: float = 10.0) -> LaserScan:
    return LaserScan(range_min=low, range_max=high, ranges=np.array(ranges, np.float32))


def test_ranges_that_were_measured() -> None:
    scan = _scan([0.5, NAN, float("inf"), -float("inf"), 0.05, 10.5, 0.0, -1.0, 10.0, 0.125])
    found = ranges_m(scan)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, [0.5] + [NAN] * 7 + [10.0, 0.125])
    assert np.isinf(scan.ranges[2])


def test_limits_that_are_not_numbers_leave_nothing() -> None:
    for low, high in ((NAN, 10.0), (0.1, NAN), (5.0, 1.0)):
        assert np.isnan(ranges_m(_scan([2.0, 3.0], low, high))).all()
    assert ranges_m(_scan([])).shape == (0,)


def test_angles() -> None:
    scan = LaserScan(angle_min=-1.5, angle_increment=0.5, ranges=np.ones(5, np.float32))
    assert angles(scan).tolist() == [-1.5, -1.0, -0.5, 0.0, 0.5]
    assert angles(LaserScan()).shape == (0,)
    backwards = LaserScan(angle_min=1.0, angle_increment=-1.0, ranges=np.ones(3, np.float32))
    assert angles(backwards).tolist() == [1.0, 0.0, -1.0]
    for bad in (LaserScan(angle_min=NAN), LaserScan(angle_increment=float("inf"))):
        with pytest.raises(BusError, match="A laser scan with angle_min"):
            angles(bad)
