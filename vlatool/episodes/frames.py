"""What a policy was given in episodes, kept to train on, and the noise that makes episodes worth training on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from vlatool.data import BEGINS
from vlatool.runtime.chunks import ChunkQueue
from vlatool.runtime.observation import ObservationEncoder

Array = NDArray[Any]


def file_of(folder: Path, name: str) -> Path:
    """Return the file of an array: names of inputs may hold anything."""
    return folder / f"{quote(name, safe='')}.npy"


class KeepingEncoder(ObservationEncoder):
    """An encoder that keeps what it encodes, when asked.

    Args:
        encode: The policy's own.
    """

    def __init__(self, encode: ObservationEncoder) -> None:
        self.names = encode.names
        self._encode = encode
        self._kept: list[dict[str, Array]] | None = None
        self._begins: list[bool] = []
        self._new = True

    def begin(self) -> None:
        """Note that an episode begins with what is encoded next."""
        self._new = True

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Array]:
        """Encode an observation, as ``ObservationEncoder`` does."""
        values = self._encode(observation)
        if self._kept is not None:
            self._kept.append({name: np.array(value) for name, value in values.items()})
            self._begins.append(self._new)
            self._new = False
        return values

    @contextlib.contextmanager
    def kept(self, folder: Path) -> Iterator[None]:
        """Keep what is encoded in this block as ``folder/NAME.npy``, (N, ...), and in which rows episodes begin."""
        self._kept, self._begins = [], []
        try:
            yield
            folder.mkdir(parents=True, exist_ok=True)
            if self._kept:
                np.save(folder / f"{BEGINS}.npy", np.array(self._begins))
            for name in self.names if self._kept else ():
                np.save(file_of(folder, name), np.concatenate([values[name] for values in self._kept]))
        finally:
            self._kept = None


class Noisy:
    """Acts as a policy does whose actions are disturbed.

    Args:
        queue: Asks the policy.
        noise: Share of the standard deviation of each element of the action that is added, normally distributed; for
            discrete actions the probability of one drawn from all labels.
        answers: Actions that the policy gives, (M, A) or (M,).
        seed: Of the draws: that of the episode.
    """

    def __init__(self, queue: ChunkQueue, noise: float, answers: Array, seed: int) -> None:
        action = queue.policy.spec.action
        self._queue, self._noise = queue, noise
        self._labels = len(action.labels) if action.kind == "discrete" else 0
        self._spread = answers.std(axis=0) * noise
        self._random = np.random.default_rng((seed, 21))

    @property
    def fresh(self) -> bool:
        """Whether the last action was the first of a chunk."""
        return self._queue.fresh

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the next action: (A,) float32, or a 0-d int64 index."""
        action = self._queue.act(observation)
        if self._labels:
            random = self._random.integers(self._labels)
            return np.asarray(random) if self._random.random() < self._noise else action
        return np.asarray(action + self._random.standard_normal(action.shape) * self._spread, action.dtype)

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode, with noise of this seed."""
        self._queue.reset(seed)
