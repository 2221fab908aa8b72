"""A policy and a controller without a bundle, which satisfy the protocols of ``vlatool.runtime.interface``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime.interface import Action

MOVES = TensorSpec("a", (1, 1, 2), labels=("x", "gripper"), mode="delta")
"""An action of two elements."""


def spec_of(chunk: int = 1, execute: int = 0, action: TensorSpec = MOVES, hz: float = 20.0) -> PolicySpec:
    """The spec of a policy that sees one number, the control step."""
    return PolicySpec((TensorSpec("t", (1, 1)),), (action,), hz, chunk, execute)


class NumberedPolicy:
    """Infers chunks of which the first element says when they were asked for: 100 t, 100 t + 1, ..."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec
        self.asked: list[Any] = []
        self.seeds: list[int | None] = []

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, NDArray[Any]] | None = None) -> Action:
        """Return the chunk that belongs to a control step."""
        self.asked.append(np.asarray(observation["t"]).item())
        rows = (100 * self.asked[-1] + np.arange(self.spec.chunk)).astype(np.float32)
        return Action(np.column_stack([rows, rows + 0.5]), self.spec.action.labels, 0.0, len(self.asked) - 1, {})

    def reset(self, seed: int | None = None) -> None:
        """Note the seed."""
        self.seeds.append(seed)


class EchoController:
    """Acts as it is told: gives back an entry of the observation, (A,)."""

    fresh = True

    def __init__(self, name: str) -> None:
        self.name = name
        self.observations: list[Mapping[str, Any]] = []

    def act(self, observation: Mapping[str, Any]) -> NDArray[Any]:
        """Return the entry of that name."""
        self.observations.append(observation)
        return np.array(observation[self.name])

    def reset(self, seed: int | None = None) -> None:
        """Nothing is carried from episode to episode."""
