"""Pictures of an episode, one for each moment, on the disk: taken by the process that plays, read by its parent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.episodes.environment import GUIDE, World
from vlatool.errors import DataError
from vlatool.runtime.image import as_rgb

RUN_AGAIN = "run the command again for the video; its episodes count as they are"

Picture = NDArray[np.uint8]
RENDERS = "rgb_array"
"""The ``render_mode`` of an environment whose ``render()`` gives an array."""
MOST_SIDE = 480
"""Pixels of the longer side of a picture; a larger one is made smaller by a whole factor."""
MOST_PICTURES, MOST_BYTES = 1000, 1 << 28
"""Largest number, and bytes, of the pictures of an episode that are kept: its first ones."""
CHUNK_BYTES = 1 << 22
"""Bytes of pictures that are in memory at a time, one picture at least."""


class Filmed(World):
    """A world that keeps a picture of each moment of an episode: of the reset, and after each step.

    Args:
        environment, task, spec, timeout_s: See ``World``.
        folder: folder of ``NUMBER.npy``, uint8 (N, H, W, 3); it is made when absent.
    """

    def __init__(self, environment: Any, task: str, spec: PolicySpec, folder: Path, timeout_s: float = 0.0) -> None:
        super().__init__(environment, task, spec, timeout_s)
        self._camera = Camera(environment, task, spec)
        self._roll = Roll(folder)

    def reset(self, seed: int) -> tuple[Mapping[str, Any], Any]:
        """Begin an episode as ``World.reset`` does, and take its first picture; raises DataError without one."""
        observation, info = super().reset(seed)
        with self._limited("render()"):
            self._roll.take(self._camera, observation)
        return observation, info

    def step(self, action: Any) -> tuple[Mapping[str, Any], bool, Any]:
        """Take an action, as ``World.step`` does, and a picture of what comes of it.

        Raises:
            DataError: when there is no picture, or one of another size than before.
        """
        observation, over, info = super().step(action)
        with self._limited("render()"):
            self._roll.take(self._camera, observation)
        if over:
            self._roll.write()
        return observation, over, info


def world_of(environment: Any, task: str, spec: PolicySpec, film: str, timeout_s: float = 0.0) -> World:
    """Return the world of an environment, filmed into a folder where one is named."""
    if film:
        return Filmed(environment, task, spec, Path(film), timeout_s)
    return World(environment, task, spec, timeout_s)


class Camera:
    """Takes pictures: what the environment renders, or else the policy's own images beside each other.

    Which of both is decided at the first picture.

    Args:
        environment: one with the ``render_mode`` ``rgb_array``, or any other.
    """

    def __init__(self, environment: Any, task: str, spec: PolicySpec) -> None:
        self._environment, self._name = environment, f"The environment of task '{task}'"
        self._images = images_of(spec)
        self._orders = {tensor.name: tensor.frame for tensor in spec.inputs}
        self._renders: bool | None = None
        self._why = ""

    def __call__(self, observation: Mapping[str, Any]) -> Picture:
        """Return this moment's picture, (H, W, 3), no side above ``MOST_SIDE``; raises DataError when there is none."""
        if self._renders is None:
            self._renders = self._can_render()
        if self._renders:
            picture = np.asarray(self._environment.render())
            if not is_picture(picture):
                raise DataError(
                    f"{self._name} renders {_describe_array(picture)} after it rendered pictures.",
                    "let render() give pictures of one size and type at each step, or leave --video out",
                )
            return fit_picture(picture)
        if not self._images:
            raise DataError(
                f"{self._name} has no picture to film: {self._why}, and the policy takes no image.",
                f"make it with render_mode='{RENDERS}', so that render() gives uint8 (height, width, 3); {GUIDE}",
            )
        return fit_picture(side_by_side([self._image(observation, name) for name in self._images]))

    def _can_render(self) -> bool:
        """Say whether the environment renders; when not, note why."""
        mode = getattr(self._environment, "render_mode", None)
        if mode != RENDERS:
            self._why = f"its render_mode is {mode!r:.40}, not '{RENDERS}'"
            return False
        try:
            picture = np.asarray(self._environment.render())
        except Exception as error:  # the seam: a user's environment may raise anything
            self._why = f"render() raises {type(error).__name__}"
            return False
        self._why = f"render() gives {_describe_array(picture)}"
        return is_picture(picture)

    def _image(self, observation: Mapping[str, Any], name: str) -> Picture:
        """Return an image of an observation: the last one of a history."""
        value = np.asarray(observation[name]) if name in observation else np.zeros(0)
        value = as_rgb(value, self._orders[name]) if self._orders.get(name) else value
        if value.ndim < 3 or not value.size or not is_picture(value.reshape(-1, *value.shape[-3:])[-1]):
            raise DataError(
                f"{self._name} gives '{name}' as {_describe_array(value)}; a picture is uint8 (..., H, W, 3).", GUIDE
            )
        return np.array(value.reshape(-1, *value.shape[-3:])[-1])


class Roll:
    """Writes pictures, some at a time, into a folder of ``NUMBER.npy``, which is made when absent."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._kept = folder, list[Picture]()
        self._shape: tuple[int, ...] = ()
        self._count = self._bytes = 0

    def take(self, camera: Camera, observation: Mapping[str, Any]) -> None:
        """Take a picture unless there are enough; raises DataError when there is none, or it has another size."""
        if self._count >= MOST_PICTURES or self._bytes >= MOST_BYTES:
            return
        picture = camera(observation)
        if picture.shape != (self._shape or picture.shape):
            raise DataError(
                f"Picture {self._count + 1} of the episode has the shape {list(picture.shape)}, those before it "
                f"{list(self._shape)}.",
                "let the environment give pictures of one size",
            )
        self._kept.append(picture)
        self._shape, self._count, self._bytes = picture.shape, self._count + 1, self._bytes + picture.nbytes
        if len(self._kept) * picture.nbytes >= CHUNK_BYTES:
            self.write()

    def write(self) -> None:
        """Write what is in memory."""
        if self._kept:
            self._folder.mkdir(parents=True, exist_ok=True)
            np.save(self._folder / f"{self._count:06d}.npy", np.stack(self._kept))
        self._kept = []


@dataclass(frozen=True)
class Film:
    """The pictures of an episode, read some at a time, as often as wanted.

    Args:
        count: Pictures in all.
        size: Height and width of each.
    """

    files: tuple[Path, ...]
    count: int
    size: tuple[int, int]

    @classmethod
    def open(cls, folder: Path) -> Film:
        """Return what was filmed into a folder; raises DataError when it holds no pictures, or something else."""
        files = tuple(sorted(folder.glob("*.npy")))
        shapes = [_read(file).shape for file in files]
        if not shapes or len({shape[1:] for shape in shapes}) != 1:
            raise DataError("The process that played the episode has left no pictures of it.", RUN_AGAIN)
        return cls(files, sum(shape[0] for shape in shapes), (shapes[0][1], shapes[0][2]))

    def __iter__(self) -> Iterator[Picture]:
        """Yield one picture after the other, (H, W, 3)."""
        for file in self.files:
            yield from _read(file)


def _read(file: Path) -> NDArray[np.uint8]:
    try:
        pictures = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{file.name}, pictures of an episode, cannot be read: {error}.", RUN_AGAIN) from error
    if not isinstance(pictures, np.ndarray) or pictures.ndim != 4 or not len(pictures) or not is_picture(pictures[0]):
        raise DataError(f"{file.name} holds no pictures of an episode.", RUN_AGAIN)
    return pictures


def images_of(spec: PolicySpec) -> tuple[str, ...]:
    """Return the names of the inputs that are images: uint8 (..., H, W, 3), or frames of a camera."""
    images = (one for one in spec.inputs if one.kind == "tensor" and one.dtype == "uint8" and len(one.shape) > 3)
    plain = {one.name for one in images if one.shape[-1] == 3}
    return tuple(one.name for one in spec.inputs if one.frame or one.name in plain)


def is_picture(value: NDArray[Any]) -> bool:
    """Say whether an array is a picture: uint8 (H, W, 3)."""
    return value.dtype == np.uint8 and value.ndim == 3 and value.shape[-1] == 3 and value.size > 0


def fit_picture(picture: Picture) -> Picture:
    """Return a picture of at most ``MOST_SIDE`` pixels a side: the means of square blocks of a larger one."""
    factor = -(-max(picture.shape[:2]) // MOST_SIDE)
    if factor < 2:
        return np.array(picture)
    height, width = (max(1, side // factor) for side in picture.shape[:2])
    down, across = (min(factor, side) for side in picture.shape[:2])
    blocks = picture[: height * down, : width * across].reshape(height, down, width, across, 3)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), np.uint8)


def side_by_side(pictures: list[Picture]) -> Picture:
    """Return pictures beside each other, lower ones with black below."""
    height = max(picture.shape[0] for picture in pictures)
    return np.concatenate([np.pad(one, ((0, height - one.shape[0]), (0, 0), (0, 0))) for one in pictures], axis=1)


def _describe_array(value: NDArray[Any]) -> str:
    return f"{value.dtype} of the shape {list(value.shape)}"
