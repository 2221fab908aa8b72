"""How far a round base can go along a path before it touches something, and whether the floor ahead is there."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
REACH_M, STEP_M = 1.0, 0.05
"""Length of the path that is looked at, and the distance between its points."""
STRIDE = 4
"""Every how many rows and columns of a depth image count."""
STANDING = 1e-3
"""Speed below which a base stands or turns in place, in m/s."""


class Mount(NamedTuple):
    """A camera on a base, level and looking forward.

    Args:
        height_m: Above the floor.
        forward_m: In front of the centre of the base.
        hfov_rad: Horizontal field of view.
    """

    height_m: float
    forward_m: float
    hfov_rad: float


def path(linear: float, angular: float) -> Array:
    """Return where the centre of a base will be, (20, 2) in metres, x forward, y to the left; (1, 2) if it stands."""
    if abs(linear) < STANDING:
        return np.zeros((1, 2))
    length = np.arange(STEP_M, REACH_M + STEP_M / 2, STEP_M)
    sign, curvature = math.copysign(1.0, linear), angular / abs(linear)
    angle = curvature * length
    with np.errstate(invalid="ignore", divide="ignore"):
        x = np.where(abs(angle) > 1e-6, np.sin(angle) / curvature, length) if curvature else length
        y = np.where(abs(angle) > 1e-6, (1.0 - np.cos(angle)) / curvature, 0.0) if curvature else 0.0 * length
    return np.stack([sign * x, sign * y], axis=1)


def clearance(points: Array, way: Array, radius_m: float) -> float:
    """Return how far a base gets along a path before a point (N, 2) is in it, in metres; infinity if it does not.

    A point that the base already touches counts where the path comes nearer to it.
    """
    if len(way) < 2 or not len(points):
        return math.inf
    square = points[:, 0] ** 2 + points[:, 1] ** 2
    near = square < (REACH_M + radius_m) ** 2
    x, y = points[near, 0], points[near, 1]
    distance = (x[None, :] - way[:, 0, None]) ** 2 + (y[None, :] - way[:, 1, None]) ** 2
    hits = (distance < radius_m**2) & (distance < square[near])
    found = np.flatnonzero(hits.any(axis=1))
    return float(found[0]) * STEP_M if len(found) else math.inf


def of_scan(angles: Array, ranges: Array) -> Array:
    """Return the points (N, 2) that a scan sees, in metres, in its own frame."""
    seen = np.isfinite(ranges)
    return np.stack([ranges[seen] * np.cos(angles[seen]), ranges[seen] * np.sin(angles[seen])], axis=1)


def has_gap(angles: Array, ranges: Array, way: Array, share: float = 0.1, least: int = 3) -> bool:
    """Whether a share of the rays along a path is unknown: those within 20 degrees of the direction it leads to.

    Args:
        least: Rays there without which nothing is known of the path.
    """
    if len(way) < 2:
        return False
    ahead = math.atan2(way[4, 1], way[4, 0])
    near = abs(np.remainder(angles - ahead + math.pi, 2.0 * math.pi) - math.pi) < math.radians(20.0)
    return int(near.sum()) < least or float(np.isnan(ranges[near]).mean()) > share


def of_depth(depth: Array, size: tuple[int, int], mount: Mount) -> Array:
    """Return the points (M, 3) that a depth image sees, in metres: x forward, y to the left, z up from the floor.

    Args:
        depth: Every ``STRIDE``th row and column, from half a stride on, in metres.
        size: (H, W) of the whole image.
    """
    rows, columns = size
    focal = columns / (2.0 * math.tan(mount.hfov_rad / 2.0))
    part = np.asarray(depth, np.float64)
    down = (np.arange(rows)[STRIDE // 2 :: STRIDE] + 0.5 - rows / 2.0) / focal
    right = (np.arange(columns)[STRIDE // 2 :: STRIDE] + 0.5 - columns / 2.0) / focal
    x, y, z = part + mount.forward_m, -part * right[None, :], mount.height_m - part * down[:, None]
    seen = np.isfinite(part) & (part > 0.0)
    return np.stack([x[seen], y[seen], z[seen]], axis=1)


def obstacles(points: Array, lowest_m: float, highest_m: float) -> Array:
    """Return where points (M, 3) between two heights stand, (N, 2)."""
    return np.asarray(points[(points[:, 2] > lowest_m) & (points[:, 2] < highest_m), :2])


def is_cliff(points: Array, way: Array, mount: Mount, half_m: float, deep_m: float, least: int = 3) -> bool:
    """Whether the floor along a path forward is missing: points (M, 3) below it, seen through where it should be.

    Args:
        half_m: Half of the width of the way.
        deep_m: Depth below the floor that counts.
        least: How many points have to be there.
    """
    if len(way) < 2 or way[0, 0] < 0.0:
        return False
    low = points[points[:, 2] < -deep_m]
    share = mount.height_m / (mount.height_m - low[:, 2])
    x, y = mount.forward_m + (low[:, 0] - mount.forward_m) * share, low[:, 1] * share
    beside = np.hypot(x[None, :] - way[:, 0, None], y[None, :] - way[:, 1, None]) < half_m
    return int(beside.any(axis=0).sum()) >= least
