"""Signals of a recording as numbers, one row for each control step; of images, how they move."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import TensorSpec
from vlatool.verify._images import channel_axis

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
GRID = 12
"""Blocks of pixels along each side of an image, of which the mean is taken."""
PARTS = 3
"""Parts of an image along each side, in each of which the motion is measured."""
MAX_COMPONENTS = 8


@dataclass(frozen=True, eq=False)
class Series:
    """Signals of whole episodes.

    Args:
        values: signal -> (N, A).
        episodes: (N,) stretch of consecutive steps that a row is of, ascending from 0.
        groups: (N,) what is left out together, the rows of a task.
    """

    values: Mapping[str, Array]
    episodes: Indices
    groups: Indices

    def __len__(self) -> int:
        return len(self.episodes)

    @functools.cached_property
    def bounds(self) -> tuple[Indices, Indices]:
        """First and last row of the episode of each row, both (N,)."""
        starts = np.searchsorted(self.episodes, np.arange(int(self.episodes[-1]) + 1))
        ends = np.append(starts[1:], len(self)) - 1
        return starts[self.episodes], ends[self.episodes]

    def rows(self, ahead: int) -> Indices:
        """Return the row some steps ahead of each, at the edge of an episode its last one."""
        first, last = self.bounds
        return np.clip(np.arange(len(self)) + ahead, first, last)

    def inside(self, ahead: int) -> NDArray[np.bool_]:
        """Return whether the episode of each row has a row so many steps ahead."""
        first, last = self.bounds
        there = np.arange(len(self)) + ahead
        return (there >= first) & (there <= last)

    def change(self, name: str) -> Array:
        """Return by how much a signal changes from each row to the next, (N, A)."""
        values = self.values[name]
        return values[self.rows(1)] - values

    def from_mean(self, name: str) -> Array:
        """Return a signal less its mean in each episode, (N, A)."""
        values = self.values[name]
        counts = np.bincount(self.episodes)[:, None]
        sums = np.zeros((len(counts), values.shape[1]))
        np.add.at(sums, self.episodes, values)
        centred: Array = values - (sums / counts)[self.episodes]
        return centred

    def part(self, chosen: NDArray[np.bool_]) -> Series:
        """Return the rows of some episodes."""
        if chosen.all():
            return self
        _, episodes = np.unique(self.episodes[chosen], return_inverse=True)
        values = {name: each[chosen] for name, each in self.values.items()}
        return Series(values, episodes.astype(np.int64), self.groups[chosen])

    def with_signals(self, names: Sequence[str], change: Callable[[Array], Array], ahead: int = 0) -> Series:
        """Return the series with other signals in the place of some: changed, and read some steps ahead."""
        values = {name: change(self.values[name])[self.rows(ahead)] for name in names}
        return replace(self, values={**self.values, **values}).part(self.inside(ahead))


def blocks(tensor: TensorSpec, frames: Any, chosen: Indices) -> Array:
    """Return the mean colours of the blocks of pixels of some images, the last moment of each: (N, G, G, C)."""
    return np.stack([_blocks(tensor, np.asarray(frames[int(row)], np.float32)) for row in chosen])


def _blocks(tensor: TensorSpec, frame: Any) -> Array:
    frame = np.moveaxis(frame, channel_axis(tensor), -1)
    frame = frame.reshape(-1, *frame.shape[-3:])[-1]
    for axis in (0, 1):
        edges = np.unique(np.linspace(0, frame.shape[axis], GRID + 1).astype(int))
        frame = np.add.reduceat(frame, edges[:-1], axis) / np.diff(edges).reshape([-1, *[1] * (2 - axis)])
    means: Array = frame.astype(np.float64)
    return means


@dataclass(frozen=True, eq=False)
class Motion:
    """Turns images into what moves in them: the changes of their components, and the motion in each part.

    Args:
        mean: (G * G,) grey levels.
        components: (K, G * G) directions in which the images of the reference differ most.
    """

    mean: Array
    components: Array

    @classmethod
    def of(cls, grey: Array) -> Motion:
        """Find the components of images (N, G, G)."""
        flat = grey.reshape(len(grey), -1)
        mean = flat.mean(axis=0)
        _, vectors = np.linalg.eigh((flat - mean).T @ (flat - mean))
        return cls(mean, vectors[:, ::-1][:, :MAX_COMPONENTS].T)

    def places(self, grey: Array) -> Array:
        """Return where images (N, G, G) are along the components: (N, K)."""
        return (grey.reshape(len(grey), -1) - self.mean) @ self.components.T

    def motion(self, grey: Array, series: Series) -> Array:
        """Return what moves from each image to the next: (N, K + parts)."""
        step = grey[series.rows(1)] - grey
        moving = np.abs(step)
        for axis in (1, 2):
            edges = np.linspace(0, moving.shape[axis], PARTS + 1).astype(int)[:-1]
            moving = np.add.reduceat(moving, edges, axis)
        directed = step.reshape(len(step), -1) @ self.components.T
        return np.concatenate([directed, np.sqrt(moving.reshape(len(moving), -1))], axis=1)
