"""Episodes beside each other: what stands where, what stands still, and what is written on it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlatool.render.filmstrip import AHEAD_INK, BAD, BAR, EDGE, GAP, GOOD, INK, LINE, MUTED_INK, TINTS, Shot, filmstrip
from vlatool.render.filmstrip import PICTURE_HEIGHT as HEIGHT

TOP = EDGE + 2 * LINE


def shot(name: str = "int8", steps: int = 6, size: tuple[int, int] = (48, 64), **more: Any) -> Shot:
    """Pictures whose red is the number of the step."""
    count = more.pop("count", steps + 1)
    pictures = [np.full((*size, 3), (step, 10, 200), np.uint8) for step in range(count)]
    return Shot(name, pictures, count, size, steps, more.pop("success", True), **more)


def drawn(*shots: Shot, title: str = "task 'push', seed 3") -> list[np.ndarray]:
    video = filmstrip(shots, title, 20.0)
    pictures = list(video.pictures())
    assert (len(pictures), video.hz) == (video.count, 20.0)
    assert all((one == two).all() for one, two in zip(pictures, video.pictures(), strict=True)), "it begins anew"
    return pictures


def has(area: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((area == colour).all(axis=-1).any())


def test_pictures_are_enlarged_by_a_whole_factor_and_the_shorter_one_stands_still():
    pictures = drawn(shot("baseline", 3), shot("int8", 6))
    wide, tall = 64 * 4, 48 * 4
    assert pictures[0].shape == (TOP + tall + BAR + EDGE, 2 * wide + GAP + 2 * EDGE, 3)
    for step, picture in enumerate(pictures):
        for left, expected in ((EDGE, min(step, 3)), (EDGE + wide + GAP, step)):
            panel = picture[TOP : TOP + tall, left : left + wide]
            assert (panel == (expected, 10, 200)).all()


@pytest.mark.parametrize(("size", "factor"), [
    ((96, 96), 2), ((56, 56), 4), ((192, 300), 1), ((480, 480), 1), ((8, 8), 24), ((1, 1), 192), ((40, 400), 1),
])  # fmt: skip
def test_the_factor_makes_small_pictures_visible_and_wide_ones_no_wider(size: tuple[int, int], factor: int):
    one = shot(size=size, steps=1)
    assert one.factor == factor
    (picture, _) = drawn(one)
    assert picture.shape[1] == max(HEIGHT, size[1] * factor) + 2 * EDGE


def captions(picture: np.ndarray, wide: int = 256) -> list[np.ndarray]:
    lefts = (EDGE, EDGE + wide + GAP)
    return [picture[EDGE + LINE : TOP, left : left + wide] for left in lefts]


def test_captions_say_how_each_episode_ends_when_it_does():
    pictures = drawn(shot("baseline", 3), shot("int8", 6, success=False))
    for step, picture in enumerate(pictures):
        base, own = captions(picture)
        assert (has(base, GOOD), has(base, INK), has(base, BAD)) == (step >= 3, step < 3, False)
        assert (has(own, BAD), has(own, INK), has(own, GOOD)) == (step == 6, step < 6, False)
        assert has(base, TINTS[0])
        assert has(own, TINTS[1])


def test_no_caption_leaves_its_panel_however_long_the_name():
    wide = drawn(shot("W" * 200, 2), shot("m" * 200, 2), title="i" * 500)
    for picture in wide:
        between = picture[:, EDGE + 256 : EDGE + 256 + GAP]
        assert not has(between[EDGE + LINE :], TINTS[0])
        assert not has(between[EDGE + LINE :], INK)
        assert not has(picture[:, -EDGE:], MUTED_INK)


def test_the_bar_is_the_whole_episode_with_a_mark_at_each_seam():
    pictures = drawn(shot(steps=8, seams=(5,)))
    middle = TOP + 192 + BAR // 2 + 1
    for step, picture in enumerate(pictures):
        bar = picture[middle, EDGE : EDGE + 256]
        reached = int((bar == TINTS[1]).all(axis=-1).sum())
        assert abs(reached - 256 * step / 8) <= 1
        assert int((bar == AHEAD_INK).all(axis=-1).sum()) == 256 - reached
        mark = picture[middle - 4, EDGE : EDGE + 256]
        assert [
            int(place) for place in np.flatnonzero((mark == (TINTS[1] if step >= 5 else AHEAD_INK)).all(axis=-1))
        ] == [128]


def test_a_seam_is_said_when_it_is_shown():
    with_seam, without = drawn(shot(steps=8, seams=(5,))), drawn(shot(steps=8))
    differs = [step for step, (one, two) in enumerate(zip(with_seam, without, strict=True))
               if (one[:TOP] != two[:TOP]).any()]  # fmt: skip
    assert differs == [5]


def test_what_was_not_filmed_to_the_end_tells_no_end():
    last = drawn(shot(steps=50, count=4))[-1]
    caption = last[EDGE + LINE : TOP]
    assert has(caption, MUTED_INK)
    assert not has(caption, GOOD)


def test_pictures_of_two_sizes_are_shown_beside_each_other():
    pictures = drawn(shot("baseline", 2, (56, 56)), shot("int8", 2, (96, 96)))
    assert pictures[0].shape[:2] == (TOP + 224 + BAR + EDGE, 224 + GAP + 192 + 2 * EDGE)
