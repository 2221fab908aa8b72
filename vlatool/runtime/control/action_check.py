"""A policy whose actions are what its spec declares, or an error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.errors import GraphError
from vlatool.runtime.contract import ON_A_ROBOT
from vlatool.runtime.interface import Action, Array, Policy, observer_of
from vlatool.runtime.observation import all_finite


class CheckedPolicy:
    """Refuses a chunk of another shape or dtype than the spec declares, or with values that no robot can execute.

    An open bundle checks its own; this is for policies of others: wrappers, clients of another machine.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy, self.spec = policy, policy.spec
        self._observer = observer_of(policy)
        action = self.spec.action
        self._labels = len(action.labels) if action.kind == "discrete" else 0
        fixed = all(isinstance(axis, int) for axis in action.shape[:-1])
        self._actions = self.spec.chunk if fixed else 0
        self._width = action.robot_width
        half = action.dtype == "float16"
        self._dtypes = {np.dtype(np.float32), np.dtype(np.float32 if half else action.dtype)}
        if self._labels:
            self._dtypes = {np.dtype(np.int64)}

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk.

        Raises:
            GraphError: when it is not as the spec declares it, or not finite.
            Exception: as the policy's ``infer`` does.
        """
        action = self.policy.infer(observation, noise=noise)
        if problem := self._problem(getattr(action, "chunk", None)):
            raise GraphError(f"{type(self.policy).__name__} gives a chunk that {problem}.", ON_A_ROBOT)
        return action

    def _problem(self, chunk: Any) -> str:
        """Return what is wrong with a chunk; nothing where it is right."""
        if not isinstance(chunk, np.ndarray) or type(chunk) is not np.ndarray:
            return f"is a {type(chunk).__name__}; allowed: an array of NumPy"
        if chunk.dtype not in self._dtypes:
            return f"is {chunk.dtype}; allowed: {' or '.join(sorted(map(str, self._dtypes)))}"
        wanted = (self._actions,) if self._labels else (self._actions, self._width)
        if chunk.ndim != len(wanted) or 0 in chunk.shape or any(map(_differ, chunk.shape, wanted)):
            return f"has the shape {list(chunk.shape)}; the spec declares {[axis or 'any' for axis in wanted]}"
        if self._labels:
            right = chunk.min() >= 0 and chunk.max() < self._labels
            return "" if right else f"holds indices outside of 0 to {self._labels - 1}"
        return "" if chunk.dtype.kind != "f" or all_finite(chunk) else "is not finite"

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation of a control step at which it does not infer."""
        if self._observer is not None:
            self._observer.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; see ``Policy.reset``."""
        self.policy.reset(seed)


def _differ(axis: int, declared: int) -> bool:
    return declared not in (0, axis)
