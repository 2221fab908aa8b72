"""Pictures of an episode: what is filmed, how much of it, and what cannot be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.episodes import film
from vlatool.episodes.film import Camera, Film, Filmed, fit_picture, images_of, side_by_side, world_of
from vlatool.errors import DataError

CAMERA = TensorSpec("front", (1, 6, 8, 3), "uint8")
HISTORY = TensorSpec("past", (1, 4, 6, 8, 3), "uint8")
STATE = TensorSpec("state", (1, 2))
DEPTH = TensorSpec("depth", (1, 6, 8, 1), "uint8")


def spec(*inputs: TensorSpec) -> PolicySpec:
    return PolicySpec(inputs=inputs, outputs=(TensorSpec("action", (1, 2)),), control_hz=10)


class Drawn:
    """An environment that renders its step number, and gives images that hold it too."""

    def __init__(self, mode: str | None = "rgb_array", size: tuple[int, int] = (6, 8), steps: int = 5) -> None:
        self.render_mode, self.size, self.steps, self.step_number = mode, size, steps, 0

    def reset(self, *, seed: int | None = None) -> Any:
        self.step_number = 0
        return self.seen(), {}

    def seen(self) -> dict[str, Any]:
        past = np.zeros((4, 6, 8, 3), np.uint8)
        past[-1] = 100 + self.step_number
        front = np.full((6, 8, 3), 50 + self.step_number, np.uint8)
        return {"state": np.zeros(2, np.float32), "front": front, "past": past[None]}

    def step(self, action: Any) -> Any:
        self.step_number += 1
        return self.seen(), 0.0, self.step_number == self.steps, False, {"success": True}

    def render(self) -> Any:
        return np.full((*self.size, 3), self.step_number, np.uint8)


def filmed(environment: Any, folder: Path, *inputs: TensorSpec) -> Film:
    world = world_of(environment, "push", spec(*inputs), str(folder))
    assert isinstance(world, Filmed)
    world.reset(1)
    over = False
    while not over:
        _, over, _ = world.step(np.zeros(2))
    return Film.open(folder)


def levels(pictures: Film) -> list[int]:
    return [int(picture[0, 0, 0]) for picture in pictures]


def test_what_the_environment_renders_is_filmed_at_the_reset_and_after_each_step(tmp_path: Path):
    film = filmed(Drawn(), tmp_path / "new/folder", CAMERA)
    assert (film.count, film.size) == (6, (6, 8))
    assert levels(film) == levels(film) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("mode", [None, "human", "ansi"])
def test_otherwise_the_images_of_the_policy_beside_each_other_the_last_of_a_history(tmp_path: Path, mode: str | None):
    film = filmed(Drawn(mode), tmp_path, STATE, CAMERA, HISTORY)
    assert film.size == (6, 16)
    first = next(iter(film))
    assert (first[:, :8] == 50).all()
    assert (first[:, 8:] == 100).all()
    assert levels(film) == [50, 51, 52, 53, 54, 55]


@pytest.mark.parametrize("wrong", [
    lambda: np.zeros((6, 8, 3)), lambda: np.zeros((6, 8), np.uint8), lambda: None, lambda: "picture",
    lambda: np.zeros((0, 8, 3), np.uint8), lambda: 1 / 0,
])  # fmt: skip
def test_what_renders_something_else_is_filmed_by_the_images(tmp_path: Path, wrong: Any):
    environment = Drawn()
    environment.render = wrong
    assert levels(filmed(environment, tmp_path, CAMERA))[0] == 50


@pytest.mark.parametrize(("mode", "inputs", "says"), [
    (None, (STATE,), "its render_mode is None, not 'rgb_array', and the policy takes no image"),
    ("human", (STATE, DEPTH), "its render_mode is 'human'"),
    ("rgb_array", (STATE,), "render\\(\\) raises ZeroDivisionError"),
])  # fmt: skip
def test_without_any_picture_the_remedy_is_named(mode: str | None, inputs: tuple[TensorSpec, ...], says: str):
    environment = Drawn(mode)
    environment.render = lambda: 1 / 0
    with pytest.raises(DataError, match=says) as caught:
        Camera(environment, "push", spec(*inputs))(environment.seen())
    assert "render_mode='rgb_array'" in caught.value.fix


@pytest.mark.parametrize(
    "value", [np.zeros((6, 8, 3)), np.zeros((6, 3), np.uint8), "x", None, np.zeros((0, 6, 8, 3), np.uint8)]
)
def test_an_image_of_another_kind_is_said(value: Any):
    environment = Drawn(None)
    with pytest.raises(DataError, match="gives 'front' as"):
        Camera(environment, "push", spec(CAMERA))({"front": value})


def test_pictures_of_changing_size_are_refused(tmp_path: Path):
    environment = Drawn()
    world = world_of(environment, "push", spec(STATE), str(tmp_path))
    world.reset(1)
    environment.size = (8, 8)
    with pytest.raises(DataError, match=r"Picture 2 of the episode has the shape \[8, 8, 3\]"):
        world.step(np.zeros(2))


def test_what_stops_rendering_is_refused(tmp_path: Path):
    environment = Drawn()
    world = world_of(environment, "push", spec(CAMERA), str(tmp_path))
    world.reset(1)
    environment.render = lambda: None
    with pytest.raises(DataError, match="renders object of the shape"):
        world.step(np.zeros(2))


def test_the_first_pictures_of_a_long_episode_are_kept_a_few_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(film, "MOST_PICTURES", 10)
    monkeypatch.setattr(film, "CHUNK_BYTES", 3 * 6 * 8 * 3)
    assert levels(filmed(Drawn(steps=25), tmp_path, CAMERA)) == list(range(10))
    sizes = [len(np.load(file)) for file in sorted(tmp_path.glob("*.npy"))]
    assert sizes == [3, 3, 3, 1]
    monkeypatch.setattr(film, "MOST_BYTES", 4 * 6 * 8 * 3)
    assert filmed(Drawn(steps=25), tmp_path / "less", CAMERA).count == 4


def test_a_picture_is_the_environments_own_no_longer(tmp_path: Path):
    environment, buffer = Drawn(), np.zeros((6, 8, 3), np.uint8)

    def render() -> Any:
        buffer[:] = environment.step_number
        return buffer

    environment.render = render
    assert levels(filmed(environment, tmp_path, CAMERA)) == [0, 1, 2, 3, 4, 5]


def test_large_pictures_are_made_smaller_by_whole_factors():
    picture = np.random.default_rng(0).integers(0, 256, (1000, 961, 3), np.uint8)
    small = fit_picture(picture)
    assert small.shape == (333, 320, 3)
    assert small[1, 2].tolist() == np.rint(picture[3:6, 6:9].reshape(-1, 3).mean(0)).tolist()
    assert fit_picture(picture[:480, :480]).shape == (480, 480, 3)
    assert fit_picture(np.ones((2, 2000, 3), np.uint8)).shape == (1, 400, 3)


def test_lower_pictures_have_black_below():
    both = side_by_side([np.full((2, 2, 3), 9, np.uint8), np.full((3, 1, 3), 7, np.uint8)])
    assert both[..., 0].tolist() == [[9, 9, 7], [9, 9, 7], [0, 0, 7]]


def test_images_are_known_by_the_spec():
    assert images_of(spec(STATE, CAMERA, DEPTH, HISTORY)) == ("front", "past")
    assert images_of(spec(STATE, TensorSpec("colours", (1, 3), "uint8"))) == ()


@pytest.mark.parametrize("content", [None, b"", b"nonsense", np.zeros((2, 4, 4, 3)), np.zeros((4, 4, 3), np.uint8),
                                     np.zeros((0, 4, 4, 3), np.uint8), np.array([object()])])  # fmt: skip
def test_a_folder_without_pictures_is_said(tmp_path: Path, content: Any):
    if isinstance(content, bytes):
        (tmp_path / "000001.npy").write_bytes(content)
    elif content is not None:
        np.save(tmp_path / "000001.npy", content, allow_pickle=True)
    with pytest.raises(DataError, match="pictures"):
        Film.open(tmp_path)
