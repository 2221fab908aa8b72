"""A controller that waits for each chunk and plays it one control step at a time."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.interface import Array, Policy, observer_of


class ChunkQueue:
    """Returns one action for each control step, and infers when the part of the chunk to execute is used up.

    Overlapping steps are refused, because the actions of a chunk belong to one robot. A reset waits for a step in
    progress.

    Args:
        execute: Number of actions to execute from each chunk; the spec's ``execute`` (or the whole chunk) when 0.

    Raises:
        UsageError: when ``execute`` is not a whole number from 0.
        PluginError: when inputs of the policy hold several moments, and it has no ``observe``.
    """

    def __init__(self, policy: Policy, execute: int = 0) -> None:
        check_whole("execute", execute, 0)
        self.policy = policy
        self._observer = observer_of(policy)
        self.execute = execute or policy.spec.execute or policy.spec.chunk
        self.fresh = False
        """Whether the last action was the first of a chunk."""
        self._turn = threading.RLock()  # a signal may arrive between acquiring the lock and setting the owner
        self._owner = 0
        self._forget()

    def _forget(self) -> None:
        self._pending: list[Array] = []

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step: (A,) float32, or a 0-d int64 index of a discrete action.

        The observation is used only if a new chunk is needed, or if inputs of the policy hold several moments. If the
        inference raises, the next step tries again.

        Raises:
            UsageError: when another step is in progress.
            DataError, GraphError: as the policy's ``infer`` or ``observe`` does.
        """
        if self._owner:
            raise UsageError("A control step begins before the last one has ended.", "make one queue for each thread")
        with self._turn:
            try:
                self._owner = threading.get_ident()
                return np.asarray(self._step(observation))
            finally:
                self._owner = 0

    def _step(self, observation: Mapping[str, Any]) -> Array:
        self.fresh = not self._pending
        if self.fresh:
            self._pending = list(self.policy.infer(observation).chunk[: self.execute])
        elif self._observer is not None:
            self._observer.observe(observation)
        return self._pending.pop(0)

    def reset(self, seed: int | None = None) -> None:
        """Discard the pending actions and the values that the policy keeps from step to step.

        Args:
            seed: Seed of the new episode's noise; see ``Policy.reset``.

        Raises:
            UsageError: when a step of this thread is in progress, or as ``Policy.reset`` does.
        """
        if self._owner == threading.get_ident():
            raise UsageError("The queue is reset within its own step (a signal handler?).", "reset between two steps")
        with self._turn:
            self._forget()
            self.policy.reset(seed)
