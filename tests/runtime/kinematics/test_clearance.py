"""Distances of segments and of arms: against a search over points, and by cases that are known."""

from __future__ import annotations

import numpy as np
import pytest
from _two_arms import two_arms

from vlatool.runtime.kinematics import segment_distances


def nearest_by_search(one: np.ndarray, two: np.ndarray) -> float:
    """The least distance of points of two segments, (2, 3) each, on finer and finer grids."""
    low, high = np.zeros(2), np.ones(2)
    for _ in range(12):
        s, t = np.meshgrid(np.linspace(low[0], high[0], 21), np.linspace(low[1], high[1], 21), indexing="ij")
        gap = (one[0] + s[..., None] * (one[1] - one[0])) - (two[0] + t[..., None] * (two[1] - two[0]))
        lengths = np.linalg.norm(gap, axis=-1)
        row, column = np.unravel_index(lengths.argmin(), lengths.shape)
        best = np.array([s[row, column], t[row, column]])
        width = (high - low) / 10
        low, high = np.maximum(best - width, 0.0), np.minimum(best + width, 1.0)
    return float(lengths.min())


def test_distances_of_random_segments_are_those_of_a_search() -> None:
    random = np.random.default_rng(1)
    segments = random.uniform(-1, 1, (60, 2, 2, 3))
    segments[:10, 0, 1] = segments[:10, 0, 0]  # points
    segments[5:15, 1, 1] = segments[5:15, 1, 0]
    segments[15:25, 1] = segments[15:25, 0] + random.uniform(-1, 1, (10, 1, 3))  # parallel
    found = segment_distances(segments[:, 0, 0], segments[:, 0, 1], segments[:, 1, 0], segments[:, 1, 1])
    expected = [nearest_by_search(*pair) for pair in segments]
    assert found == pytest.approx(expected, abs=1e-6)


def test_the_distance_of_two_arms_is_that_of_their_nearest_links() -> None:
    distance = two_arms()
    assert distance([0.0, 0.0]) == pytest.approx(0.1)  # ahead of each other: 0.2 m less both radii
    assert distance([np.pi / 2, 0.0]) == pytest.approx(0.6 - 0.15)  # one tip and the other base
    assert distance([np.pi, np.pi]) == pytest.approx(0.8)
    assert distance(np.zeros((3, 4, 2))).shape == (3, 4)
