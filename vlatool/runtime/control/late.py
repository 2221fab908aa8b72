"""A controller that acts while its policy infers: each chunk arrives as late as its inference takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.action_elements import ActionElements
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.interface import CHUNK, HOLD, Action, Array, Policy


class LateController(ChunkQueue):
    """Acts like a robot that keeps moving while its policy infers.

    When the part of a chunk to execute is used up, an inference starts with the observation of that step, and its chunk
    is used from ``delay`` steps later on. Until then, the steps use the rest of the last chunk, and after that they
    hold: no motion if the action is a delta or a velocity (the gripper keeps its command), else the last action again.
    The new chunk skips as many actions as were taken from the last one meanwhile. The controller waits for the first
    chunk. ``act`` runs the inference itself and withholds the chunk, so that the actions depend only on ``delay``.

    Args:
        execute: Number of actions to execute from each chunk; the spec's ``execute`` (or the whole chunk) when 0.
        delay: Number of whole control steps that an inference takes; 0 if it ends within the step in which it starts.
        clock: Returns seconds; the age of actions is measured with it.

    Raises:
        UsageError: when ``delay`` is not a whole number from 0, or ``execute`` one from 0 to the length of a chunk.
    """

    def __init__(
        self, policy: Policy, execute: int = 0, *, delay: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        check_whole("delay", delay, 0)
        self._delay = delay
        super().__init__(policy, execute, clock=clock)

    def _forget(self) -> None:
        super()._forget()
        self._coming: tuple[Action, float] | None = None
        self._wait = self._taken = 0
        self._last: Array | None = None

    def _step(self, observation: Mapping[str, Any]) -> Array:
        if not self._pending and self._coming is None:
            self._coming = self.policy.infer(observation), self._clock()
            self._wait, self._taken = (0 if self._last is None else self._delay), 0
        elif self._observer is not None:
            self._observer.observe(observation)
        self.fresh = self._coming is not None and self._wait == 0
        if self._coming is not None and self._wait == 0:
            self._play(*self._coming, self._taken)
            self._coming = None
        self._last = np.asarray(self._next())
        return self._last

    def _next(self) -> Array:
        if self._pending:
            self._note()
            return self._pending.pop(0)
        self._wait -= 1
        if (row := next(self._rest, None)) is not None:
            self._taken += 1
            self._note(CHUNK)
            return row
        self._note(HOLD)
        return hold(self.policy.spec.action, self._last)


def hold(action: TensorSpec, last: Array | None) -> Array:
    """Return the action of a robot without a new one: no motion if the mode can express that, else the last action.

    No motion is 0, of a rotation the identity; the gripper keeps its command.

    Raises:
        ValueError: when there is no last action.
    """
    if last is None:
        raise ValueError("there is no action to hold")
    return ActionElements(action).hold(last)
