"""Texts of another task than the images of a log are of."""

from __future__ import annotations

import numpy as np
import pytest

from vlatool.verify._appearance import Looks
from vlatool.verify._tasks import Tasks

ROWS, GRID = 12, 12
TASKS = {"open the drawer": 0, "pull the drawer": 0, "close the window": 1, "press the button": 2}


def looks(scene: int, seed: int, light: float = 1.0) -> Looks:
    """Images of a scene: a wall that is the same in all, and an object elsewhere in each."""
    random = np.random.default_rng([seed, 1])
    wall = np.random.default_rng(0).uniform(50, 90, (GRID, GRID, 3))
    images = np.repeat(wall[None], ROWS, axis=0) + random.normal(0, 2, (ROWS, GRID, GRID, 3))
    row = 3 + int(random.integers(3))
    images[:, row : row + 4, 3 * scene : 3 * scene + 4] += (
        np.array([120, 40, 10]) * np.roll(np.eye(3), scene, axis=1)[0]
    )
    return Looks(light * images, light * images.reshape(ROWS, -1, 3))


def reference(scenes: dict[str, int], episodes: int = 4) -> tuple[dict[str, Looks], list[str], np.ndarray]:
    """Episodes of each text."""
    texts = [text for text in scenes for _ in range(episodes)]
    seen = [looks(scenes[text], seed) for seed, text in enumerate(texts)]
    joined = Looks(np.concatenate([each.blocks for each in seen]), np.concatenate([each.colours for each in seen]))
    return {"image": joined}, [text for text in texts for _ in range(ROWS)], np.repeat(np.arange(len(texts)), ROWS)


@pytest.fixture(scope="module")
def tasks() -> Tasks:
    found = Tasks.of(*reference(TASKS))
    assert found is not None
    return found


@pytest.mark.parametrize("light", [1.0, 0.8])
@pytest.mark.parametrize("text", TASKS)
def test_right_texts_are_not_accused(tasks, text, light):
    assert list(tasks.explain("task", {"image": looks(TASKS[text], 100, light)}, [text] * ROWS)) == []


@pytest.mark.parametrize(("text", "scene", "like"), [("close the window", 0, "'open the drawer' or 'pull the drawer'"),
                                                     ("open the drawer", 1, "'close the window'")])  # fmt: skip
def test_a_text_of_another_task_is_named_with_that(tasks, text, scene, like):
    (found,) = tasks.explain("task", {"image": looks(scene, 100)}, [text] * ROWS)
    assert (found.signal, found.kind) == ("task", "text")
    assert found.where == f"it is {text!r} in 12 rows, whose images look like those of {like}"
    assert found.evidence > found.needed


def test_texts_of_one_scene_are_one_task(tasks):
    assert tasks.texts["open the drawer"] == tasks.texts["pull the drawer"] != tasks.texts["close the window"]
    assert list(tasks.explain("task", {"image": looks(0, 100)}, ["pull the drawer"] * ROWS)) == []


def test_unknown_texts_are_left_to_others(tasks):
    assert list(tasks.explain("task", {"image": looks(0, 100)}, ["wave"] * ROWS)) == []


def test_nothing_is_told_where_tasks_look_alike_or_change_within_an_episode():
    assert Tasks.of(*reference(dict.fromkeys(TASKS, 0))) is None
    assert Tasks.of(*reference(TASKS, episodes=1)) is None
    images, texts, episodes = reference(TASKS)
    assert Tasks.of(images, [*texts[1:], texts[0]], episodes) is None
    assert Tasks.of({}, texts, episodes) is None
