"""The envelope of a robot for whole chunks, of which its client plays the first actions."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.runtime.control.envelope import EnvelopeController
from vlatool.runtime.envelope import Envelope
from vlatool.runtime.stack import robot_envelope

Array = NDArray[Any]


class _Row:
    """A controller that gives the action that was put into it."""

    fresh = True

    def __init__(self) -> None:
        self.action: Array = np.empty(0)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action."""
        return self.action

    def reset(self, seed: int | None = None) -> None:
        """Nothing is kept."""


class _Time:
    """A clock that goes on by one control period each time it is read; copies of an envelope share it."""

    def __init__(self) -> None:
        self.now, self.period_s = 0.0, 0.0

    def __call__(self) -> float:
        self.now += self.period_s
        return self.now

    def __deepcopy__(self, memo: dict[int, Any]) -> _Time:
        return self


class ChunkEnvelope:
    """Keeps the actions of chunks within the limits of a robot, as if each were sent one control period after another.

    The next chunk begins where the robot is after the actions that were played, which the client says, or which are
    assumed. What the client does otherwise, it does outside of the envelope: the robot's own controller should have
    one, too.

    Args:
        robot: Name of the robot.

    Raises:
        ProfileError, UsageError: as ``robot_envelope`` does.
    """

    def __init__(self, spec: PolicySpec, robot: str) -> None:
        self._row, self._time = _Row(), _Time()
        controller = robot_envelope(spec, robot)(self._row)
        if not isinstance(controller, EnvelopeController):
            raise TypeError("robot_envelope wraps controllers in an EnvelopeController")
        self._controller = controller
        controller.envelope.clock, self._time.period_s = self._time, controller.envelope.period_s
        self._before = self._copy(), self._time.now
        self._chunk: list[Array] = []
        self._observation: Mapping[str, Any] = {}

    def _copy(self) -> Envelope:
        """Return a copy of the envelope that shares its limits, which nobody changes."""
        envelope = self._controller.envelope
        return copy.deepcopy(envelope, {id(envelope.limits): envelope.limits})

    def apply(self, chunk: Array, observation: Mapping[str, Any], played: int) -> tuple[Array, tuple[str, ...]]:
        """Return the chunk within the limits, and the names of the checks that changed it.

        Args:
            chunk: (T, A) in the units of the spec.
            observation: Inputs of the policy by name; the first has the position of the robot.
            played: Actions of the chunk before that the robot has played.

        Returns:
            The caller's own chunk where nothing changed; else (T, A) float64.

        Raises:
            DataError: when the robot is not where its limits allow, at the first chunk.
        """
        self._controller.envelope, self._time.now = self._before
        for action in self._chunk[:played]:
            self._step(action, self._observation)
        self._before = self._copy(), self._time.now
        checks: dict[str, None] = {}
        rows = []
        self._chunk = []
        for action in chunk:
            rows.append(self._step(action, observation))
            if self._controller.result is not None:
                checks.update(dict.fromkeys(self._controller.result.checks))
        self._chunk, self._observation = list(chunk), observation
        return (np.array(rows, np.float64) if checks else chunk), tuple(checks)

    def _step(self, action: Array, observation: Mapping[str, Any]) -> Array:
        self._row.action = action
        return self._controller.act(observation)
