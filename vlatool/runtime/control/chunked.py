"""A controller that waits for each chunk and plays it one control step at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.interface import CHUNK, Action, Array, Origin, Policy, observer_of


class ChunkQueue:
    """Returns one action for each control step, and infers when the part of the chunk to execute is used up.

    Overlapping steps are refused, because the actions of a chunk belong to one robot. A reset waits for a step in
    progress.

    Args:
        execute: Number of actions to execute from each chunk; the spec's ``execute`` (or the whole chunk) when 0.
        clock: Returns seconds; the age of actions is measured with it.

    Raises:
        UsageError: when ``execute`` is not a whole number from 0 to the length of a chunk.
        PluginError: when inputs of the policy hold several moments, and it has no ``observe``.
    """

    def __init__(self, policy: Policy, execute: int = 0, *, clock: Callable[[], float] = time.monotonic) -> None:
        check_whole("execute", execute, 0, policy.spec.chunk)
        self.policy = policy
        self._observer = observer_of(policy)
        self.execute = execute or policy.spec.execute or policy.spec.chunk
        self.fresh = False
        """Whether the last action was the first of a chunk."""
        self.origin = Origin("")
        """Where the last action came from."""
        self.played: Action | None = None
        """The inference whose chunk is played; None before the first, and where the controller mixes several."""
        self._clock = clock
        self._turn = threading.RLock()  # a signal may arrive between acquiring the lock and setting the owner
        self._owner = 0
        self._forget()

    def _forget(self) -> None:
        self._pending: list[Array] = []
        self._rest: Iterator[Array] = iter(())

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
                return np.array(self._step(observation))  # a copy: the caller may change its own
            finally:
                self._owner = 0

    def _step(self, observation: Mapping[str, Any]) -> Array:
        self.fresh = not self._pending
        if self.fresh:
            self._play(self.policy.infer(observation), self._clock())
        elif self._observer is not None:
            self._observer.observe(observation)
        self._note()
        return self._pending.pop(0)

    def _play(self, action: Action, arrived: float, skip: int = 0) -> None:
        """Take the actions of a chunk from now on, without the first ``skip``; it arrived at a time of the clock."""
        last = skip + self.execute
        self._pending, self._rest = list(action.chunk[skip:last]), iter(action.chunk[last:])
        self.played, self._arrived = action, arrived

    def _note(self, source: str = "") -> None:
        """Store where the action of this step comes from: the chunk that is played, or ``source`` with its age."""
        played = self.played
        origin = Origin("") if played is None else played.origin((self._clock() - self._arrived) * 1e3)
        self.origin = origin._replace(source=source) if source else origin

    def rest(self) -> Array | None:
        """Return the next action of the last chunk, also beyond those to execute; None when there is none.

        It answers a control step for which no inference came in time.
        """
        with self._turn:
            action = self._pending.pop(0) if self._pending else next(self._rest, None)
            if action is None:
                return None
            self.fresh = False
            self._note(CHUNK)
            return np.array(action)

    def drop(self) -> None:
        """Discard the pending actions, so that the next step infers; the policy keeps its values."""
        with self._turn:
            self._forget()

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
