"""Recorded inputs of a policy, to train on, and the noise that makes episodes worth training on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import BEGINS
from vlatool.runtime.interface import Action, Array, Controller, Origin, Policy, observer_of, origin_of
from vlatool.runtime.observation import ObservationEncoder


def file_of(folder: Path, name: str) -> Path:
    """Return the file of an array: names of inputs may hold anything."""
    return folder / f"{quote(name, safe='')}.npy"


class FrameRecorder:
    """A policy that records what another one is given, as the graphs take it, when asked."""

    def __init__(self, policy: Policy, encode: ObservationEncoder) -> None:
        self.spec: PolicySpec = policy.spec
        self.policy, self._observer, self._encode = policy, observer_of(policy), encode
        self._frames: list[dict[str, Array]] | None = None
        self._begins: list[bool] = []
        self._new = True

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk, as the policy does."""
        if self._frames is not None:
            observation = self._encode(observation)
            self._frames.append({name: np.array(value) for name, value in observation.items()})
            self._begins.append(self._new)
            self._new = False
        return self.policy.infer(observation, noise=noise)

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation of a control step at which it does not infer."""
        if self._observer is not None:
            self._observer.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode: it begins with the frame that is recorded next."""
        self._new = True
        self.policy.reset(seed)

    @contextlib.contextmanager
    def recording(self, folder: Path) -> Iterator[None]:
        """Record the inferences of this block as ``folder/NAME.npy``, (N, ...), and in which rows episodes begin."""
        self._frames, self._begins = [], []
        try:
            yield
            folder.mkdir(parents=True, exist_ok=True)
            if self._frames:
                np.save(folder / f"{BEGINS}.npy", np.array(self._begins))
            for name in self._encode.names if self._frames else ():
                np.save(file_of(folder, name), np.concatenate([frame[name] for frame in self._frames]))
        finally:
            self._frames = None


class Noisy:
    """A controller that adds noise to the actions of another one.

    Args:
        noise: Share of the standard deviation of each element of the action that is added, normally distributed; for
            discrete actions the probability of one drawn from all labels.
        answers: Actions that the policy gives, (M, A) or (M,).
    """

    def __init__(self, controller: Controller, action: TensorSpec, noise: float, answers: Array) -> None:
        self._controller, self._noise = controller, noise
        self._labels = len(action.labels) if action.kind == "discrete" else 0
        self._spread = answers.std(axis=0) * noise
        self._random = np.random.default_rng((0, 21))
        self.fresh, self.origin = False, Origin("")

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the next action: (A,) float32, or a 0-d int64 index."""
        action, self.fresh = self._controller.act(observation), self._controller.fresh
        self.origin = origin_of(self._controller)
        if self._labels:
            random = self._random.integers(self._labels)
            return np.asarray(random) if self._random.random() < self._noise else action
        return np.asarray(action + self._random.standard_normal(action.shape) * self._spread, action.dtype)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, with noise of this seed."""
        self._random = np.random.default_rng((seed or 0, 21))
        self._controller.reset(seed)
