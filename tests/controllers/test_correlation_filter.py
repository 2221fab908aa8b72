from __future__ import annotations

import numpy as np
import pytest

from vlatool.controllers._correlation_filter import Box, begin, follow


def scene(x: float, y: float, random_seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """A textured disc on a textured background, (120, 160) grey levels."""
    random = np.random.default_rng(random_seed)
    rows, columns = np.mgrid[0:120, 0:160]
    image = 60 + 20 * np.sin(columns / 9.0) + 20 * np.cos(rows / 7.0)
    inside = (columns - x) ** 2 + (rows - y) ** 2 < 15**2
    disc = 170 + 50 * np.sin((columns - x) / 3.0) * np.cos((rows - y) / 4.0)
    return np.where(inside, disc, image) + random.normal(0, noise, image.shape) + 30


@pytest.mark.parametrize("seed", range(4))
def test_it_follows_a_target_over_a_random_path_through_noise(seed: int):
    random = np.random.default_rng(seed)
    x, y = 80.0, 60.0
    known = begin(scene(x, y), Box(x, y, 30, 30))
    for step in range(40):
        x, y = np.clip(x + random.normal(0, 3), 30, 130), np.clip(y + random.normal(0, 3), 30, 90)
        known, visible = follow(scene(x, y, step, noise=6.0), known)
        assert visible
        assert (known.box.x, known.box.y) == pytest.approx((x, y), abs=3.0)


def test_a_target_that_is_gone_is_lost_and_found_again_where_it_was():
    known = begin(scene(80, 60), Box(80, 60, 30, 30))
    known, _ = follow(scene(82, 60), known)
    empty = np.random.default_rng(1).normal(100, 5, (120, 160))
    after, visible = follow(empty, known)
    assert not visible
    assert after is known
    assert follow(scene(83, 60), after)[1]


def test_a_target_at_the_edge_and_a_uniform_image_do_not_raise():
    known = begin(scene(5, 5), Box(5, 5, 30, 30))
    assert len(known.numerator) == 64
    assert not follow(np.zeros((120, 160)), known)[1]
