"""Temporal ensembling: infers at every control step, and averages what all chunks so far say of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.runtime.action_elements import ActionElements
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.interface import Array, Policy

ACT_COEFFICIENT = 0.01
"""Coefficient of ACT (Zhao et al. 2023, arXiv 2304.13705, appendix)."""
LARGEST_EXPONENT = 80.0
"""Weights exp(80) and sums of them are float32 still."""


class TemporalEnsemble(ChunkQueue):
    """Returns the weighted mean of the actions that all chunks so far have for a control step.

    The i-th oldest of these chunks has the weight exp(-coefficient i), i from 0, as in algorithm 2 of ACT and in
    LeRobot's ``ACTTemporalEnsembler``, whose recursion in float32 this is: a positive coefficient prefers older chunks,
    a negative one newer, 0 none. Rotations are averaged along the shortest arc.

    Raises:
        UsageError: when the coefficient is not a finite number, or so negative that the weights of a whole chunk are
            beyond float32, or actions of two chunks cannot be averaged: labels, or differences from the states of two
            inferences.
    """

    def __init__(
        self, policy: Policy, *, coefficient: float = ACT_COEFFICIENT, clock: Callable[[], float] = time.monotonic
    ) -> None:
        action, chunk = policy.spec.action, policy.spec.chunk
        least = -LARGEST_EXPONENT / max(1, chunk - 1)
        if isinstance(coefficient, bool) or not least <= coefficient < math.inf:
            raise UsageError(f"coefficient is {coefficient!r}; allowed for a chunk of {chunk}: numbers from {least:g}.",
                             f"ACT has {ACT_COEFFICIENT}")  # fmt: skip
        if action.kind == "discrete" or action.mode == "relative":
            what = "labels" if action.kind == "discrete" else "differences from the states of different inferences"
            raise UsageError(f"'{action.name}' has {what}, which cannot be averaged.", "use another controller")
        self._elements = ActionElements(action)
        weights = np.array([math.exp(-coefficient * index) for index in range(chunk)])
        self._weights, self._sums = weights.astype(np.float32)[:, None], weights.cumsum().astype(np.float32)[:, None]
        super().__init__(policy, clock=clock)

    def _forget(self) -> None:
        super()._forget()
        self._mean: Array = np.empty((0, 0), np.float32)
        self._counts = np.empty(0, np.int64)

    def _step(self, observation: Mapping[str, Any]) -> Array:
        action = self.policy.infer(observation)
        chunk = np.asarray(action.chunk, np.float32)
        self.fresh, self.origin = True, action.origin()
        earlier = len(self._mean)
        mean = np.concatenate([self._updated(chunk[:earlier]), chunk[earlier:]]) if earlier else chunk
        counts = np.concatenate([self._counts + 1, np.ones(len(chunk) - earlier, np.int64)])
        self._mean, self._counts = mean[1:], counts[1:]
        return np.asarray(mean[0])

    def _updated(self, actions: Array) -> Array:
        """Return the means of the steps to come with the actions of one more chunk, (T, A)."""
        before, after = self._sums[self._counts - 1], self._sums[self._counts]
        weights = self._weights[self._counts]
        mean = (self._mean * before + actions * weights) / after
        shares = (weights / after)[:, 0]
        return self._elements.mix_rotations(mean, self._mean, actions, shares)
