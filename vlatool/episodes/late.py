"""A policy whose actions come as late in the control loop as its inferences take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import TensorSpec
from vlatool.episodes.body import gripper_of
from vlatool.runtime.chunks import ChunkQueue
from vlatool.runtime.policy import FIRST_RUN_S

Array = NDArray[Any]
STOPS = ("delta", "velocity")
"""Modes of an action in which 0 stands for no motion."""


class Late:
    """Acts as a robot does that goes on while its policy thinks.

    When the executed part of a chunk is used up, an inference begins with the observation of that step. Its chunk is
    there ``late`` steps later; the steps until then take what is left of the last chunk, and then hold: no motion where
    the action is a delta or a velocity (the gripper keeps its command), the last action again otherwise. As many
    actions of the new chunk are left out as were taken from the last one meanwhile. The first chunk is waited for.

    Args:
        queue: Whose policy is asked, and how much of a chunk is executed.
        late: Control steps that an inference takes: whole ones, for one that ends within its own step is in time.
    """

    def __init__(self, queue: ChunkQueue, late: int) -> None:
        self._policy, self._execute, self._late = queue.policy, queue.execute, late
        self._action = queue.policy.spec.action
        self.fresh = False
        """Whether the last action was the first of a chunk."""
        self._begin()

    def _begin(self) -> None:
        self._pending: list[Array] = []
        self._rest: list[Array] = []
        self._coming: Array | None = None
        self._wait = self._taken = 0
        self._last: Array | None = None

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step: (A,) float32, or a 0-d int64 index.

        Raises:
            DataError, GraphError: as ``Policy.infer`` does, and when an inference takes too long.
        """
        if not self._pending and self._coming is None:
            with self._policy.stopped_after(FIRST_RUN_S):
                self._coming = self._policy.infer(observation).chunk
            self._wait, self._taken = (0 if self._last is None else self._late), 0
        self.fresh = self._coming is not None and self._wait == 0
        if self._coming is not None and self._wait == 0:
            chunk = list(self._coming[self._taken :])
            self._pending, self._rest, self._coming = chunk[: self._execute], chunk[self._execute :], None
        self._last = np.asarray(self._next())
        return self._last

    def _next(self) -> Array:
        if self._pending:
            return self._pending.pop(0)
        self._wait -= 1
        if self._rest:
            self._taken += 1
            return self._rest.pop(0)
        return held(self._action, self._last)

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode, with noise of this seed."""
        self._begin()
        self._policy.reset(seed)


def held(action: TensorSpec, last: Array | None) -> Array:
    """Return what a robot does that has no action: it stops where it can be told to, and repeats the last otherwise."""
    if last is None:
        raise ValueError("nothing was done yet")
    if action.kind == "discrete" or action.mode not in STOPS:
        return last.copy()
    still = np.zeros_like(last)
    if (grip := gripper_of(action)) is not None:
        still[grip] = last[grip]
    return still
