"""A controller that answers every control step: where the policy has no action, the next rung of a ladder has one."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import DeadlineMissed, UsageError
from vlatool.files.validate import short_repr
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.interface import STOP, Array, Controller, Origin, layers_of
from vlatool.runtime.rungs import ChunkRung, Hold, PolicyRung, Rung, Stop

HOLD_S = 1.0
"""How long a robot holds before it counts as stopped."""


class FallbackLadder:
    """Asks one rung after the other until one has an action: the policy, the rest of its chunk, ..., a stop.

    The ladder stands on a rung, at first on the policy. When that has no action in ``misses`` of the last ``window``
    steps at which it was asked, the ladder steps down to the next one that does not only bridge, and stays there. The
    rungs above go on to be asked, their actions are discarded, and the first that answers ``recover`` steps in a row,
    each time with a new inference, has the robot again.

    Args:
        rungs: What is below the policy; the rest of the chunk, a hold of ``HOLD_S`` and a stop when None.
        misses: Steps without an action until the ladder steps down.
        window: Steps of which these are.
        recover: Steps in a row with an action until it steps up again.
        latch: Whether it stays on the last rung until ``reset``.
        start: The action that stands for the last one before the first, (A,): the pose that the robot has.
        clock: Returns seconds; the age of a held action is measured with it.

    Raises:
        UsageError: when a number is not a whole one from 1, the start is not a finite number for each element of the
            action, or no label of a discrete action means no motion.
    """

    def __init__(
        self,
        controller: Controller,
        rungs: Sequence[Rung] | None = None,
        *,
        misses: int = 3,
        window: int = 10,
        recover: int = 5,
        latch: bool = False,
        start: Any = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        for name, value in (("misses", misses), ("window", window), ("recover", recover)):
            check_whole(name, value, 1)
        self.controller = controller
        lower = default_rungs(controller) if rungs is None else rungs
        self.rungs = [PolicyRung(controller), *lower]
        self._misses, self._recover, self._latch, self._clock = misses, recover, latch, clock
        self._start = None if start is None else _pose(controller, start)
        self._asked: deque[bool] = deque(maxlen=max(window, misses))
        self._forget()

    def _forget(self) -> None:
        self.level = 0
        """Index of the rung that the ladder stands on."""
        self.rung = 0
        """Index of the rung that answered the last step."""
        self.error: Exception | None = None
        """Why the policy had no action at the last step; None where it had one."""
        self.fresh, self.origin = False, Origin("")
        self._last = self._start
        self._asked.clear()
        self._streaks = [0] * len(self.rungs)
        self._age: tuple[float, float] | None = None

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step: (A,) float32, or a 0-d int64 index of a discrete action.

        Raises:
            Exception: what the policy raised, when no rung has an action: nothing is known yet that could be held.
        """
        self.error = None
        for index, rung in enumerate(self.rungs):
            if not self._asks(index):
                rung.watch(observation)
                continue
            try:
                action = rung.act(observation, self._last)
            except Exception as error:  # the seam: a policy of another package raises anything, and the robot moves
                self.error = self.error or error
                self._note(index, answered=False)
                continue
            if self._note(index, answered=True):
                return self._use(index, action, observation)
            rung.pause()
        self.rung, self.fresh, self.origin = len(self.rungs) - 1, False, Origin(STOP)
        raise self.error or DeadlineMissed("The ladder is stopped.", "reset it")

    def _asks(self, index: int) -> bool:
        """Return whether a rung is asked: those above to see whether they recover, a bridge where it has to."""
        if index < self.level and self._latch and self.level == len(self.rungs) - 1:
            return False
        return not self.rungs[index].bridges or self.level == index - 1

    def _note(self, index: int, *, answered: bool) -> bool:
        """Count an answer, or that there was none, and step up or down; returns whether the answer is to be used."""
        if index < self.level:
            self._streaks[index] = self._streaks[index] + 1 if answered else 0
            if self._streaks[index] < self._recover:
                return False
            self._stand_on(index)
        elif index == self.level:
            self._asked.append(not answered)
            if sum(self._asked) >= self._misses:
                below = [lower for lower in range(index + 1, len(self.rungs)) if not self.rungs[lower].bridges]
                self._stand_on(below[0] if below else index)
        return answered

    def _stand_on(self, index: int) -> None:
        self.level = index
        self._asked.clear()
        self._streaks = [0] * len(self.rungs)

    def _use(self, index: int, action: Array, observation: Mapping[str, Any]) -> Array:
        rung, now = self.rungs[index], self._clock()
        for other in self.rungs[index + 1 : self.rung + 1]:
            other.pause()
        for other in self.rungs[index + 1 :]:
            other.watch(observation)
        self.rung, self._last, self.origin = (
            index,
            np.array(action),
            rung.origin,
        )  # a copy: the caller may change its own
        self.fresh = isinstance(rung, PolicyRung) and rung.controller.fresh
        if isinstance(rung, Hold):
            age = None if self._age is None else self._age[0] + (now - self._age[1]) * 1e3
            self.origin = rung.origin._replace(age_ms=age)
        elif rung.origin.age_ms is not None:
            self._age = rung.origin.age_ms, now
        return action

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode on the first rung.

        Raises:
            UsageError: as ``Policy.reset`` does.
        """
        for rung in self.rungs:
            rung.reset(seed)
        self._forget()


def default_rungs(controller: Controller) -> list[Rung]:
    """Return the rest of the chunk, where a controller has that, a hold and a stop."""
    spec = _spec_of(controller)
    player = next((layer for layer in layers_of(controller) if hasattr(layer, "rest")), None)
    bridge: list[Rung] = [] if player is None else [ChunkRung(player)]
    steps = max(1, round(HOLD_S * (spec.control_hz or 1.0)))
    return [*bridge, Hold(spec.action, steps), Stop(spec.action)]


def _spec_of(controller: Controller) -> PolicySpec:
    return next(layer.spec for layer in layers_of(controller) if hasattr(layer, "spec"))  # type: ignore[no-any-return]


def _pose(controller: Controller, start: Any) -> Array:
    """Return a start as an action, (A,) float32; raises UsageError when it is none."""
    width = _spec_of(controller).action.robot_width
    try:
        pose = np.array(start, np.float32)
    except (TypeError, ValueError):
        pose = np.empty(0, np.float32)
    if pose.shape != (width,) or not np.isfinite(pose).all():
        raise UsageError(
            f"start is {short_repr(start)}; allowed: {width} finite numbers, one for each element of the action.",
            "pass the pose of the robot, in the units of the action",
        )
    return pose
