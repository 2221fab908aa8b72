"""Inferences of which a test says how long each takes, and policies whose chunks join or do not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from _numbered import NumberedPolicy

from vlatool.runtime.control._inference import PlayedInference
from vlatool.runtime.control.asynchronous import AsynchronousController
from vlatool.runtime.interface import Action, Policy


class ScriptedInference(PlayedInference):
    """Takes so many control steps as a list says, the last number for all further inferences."""

    def __init__(self, policy: Policy, delays: Iterable[int]) -> None:
        super().__init__(policy, 0)
        self._delays = list(delays)

    def start(self, observation: Mapping[str, Any]) -> None:
        """Infer, and withhold the chunk for the next number of steps."""
        super().start(observation)
        self._delay = self._delays.pop(0) if len(self._delays) > 1 else self._delays[0]


def scripted(controller: AsynchronousController, delays: Iterable[int]) -> AsynchronousController:
    """Return the controller with inferences that take so many steps, the first of which is waited for."""
    controller._inference = ScriptedInference(controller.policy, delays)
    return controller


class Path(NumberedPolicy):
    """Infers the positions, or the steps, of one path: the same whenever it is asked, but for an error each time."""

    error = 0.0

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        """Return the path from the control step of the observation on."""
        self.asked.append(float(np.asarray(observation["t"]).item()))
        shift = self.error * (-1) ** len(self.asked)
        chunk = np.stack([self.at(self.asked[-1] + place) + shift for place in range(self.spec.chunk)])
        return Action(chunk.astype(np.float32), (), 0.0, len(self.asked) - 1, {})

    def at(self, time: float) -> Any:
        """Return the action that belongs to a control step, (A,)."""
        return np.array([np.sin(time / 20), 1.0])
