"""What succeeds without looking: actions that have nothing to do with the observation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.interface import Array, Policy

CONTROLS = ("random", "constant")
ANSWERED_OBSERVATIONS = 32
"""Observations that a policy is asked for the actions that its controls play."""


def answers_of(policy: Policy, observations: Iterable[Mapping[str, Any]]) -> Array:
    """Return the actions that a policy gives on observations, all of their chunks: (M, A) float32, or (M,) int64."""
    policy.reset()
    chunks = [policy.infer(observation).chunk for observation in observations]
    policy.reset()
    return np.concatenate(chunks)


class Blind:
    """A controller that acts as a policy would that sees nothing.

    Args:
        control: ``random``: actions drawn from those that the policy gives (discrete: from all labels);
            ``constant``: always the mean of them (discrete: the most frequent one).
        answers: Actions that the policy gives, (M, A) or (M,).
    """

    def __init__(self, control: str, action: TensorSpec, answers: Array) -> None:
        self.fresh = True
        self._labels = len(action.labels) if action.kind == "discrete" else 0
        self._answers = answers
        self._constant = self._middle() if control == "constant" else None
        self.reset()

    def _middle(self) -> Array:
        if self._labels:
            return np.asarray(np.bincount(self._answers, minlength=self._labels).argmax())
        return np.asarray(self._answers.mean(axis=0), self._answers.dtype)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the next action: (A,) float32, or a 0-d int64 index."""
        if self._constant is not None:
            return self._constant.copy()
        if self._labels:
            return np.asarray(self._random.integers(self._labels))
        return np.array(self._answers[self._random.integers(len(self._answers))])

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, with draws of this seed."""
        self._random = np.random.default_rng((seed or 0, 20))
