"""Disturbances that the evaluation makes itself, for any environment: observations arrive late, or not at all."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.runtime.interface import Array, Controller, Origin, origin_of

DELAY, DROPPED_FRAMES = "delay", "dropped_frames"
BUILT_IN_DISTURBANCES = (DELAY, DROPPED_FRAMES)
DELAY_S = 0.05
"""How old an observation is at strength 1: a camera's exposure, transfer and decoding; one control step at least."""
DROPPED_SHARE, MAX_DROPPED_SHARE = 0.1, 0.9
"""How many observations are lost at strength 1, and at most."""


class DisturbedController:
    """A controller whose observations arrive late, or not at all.

    ``delay`` gives each observation some control steps late, the first one until then; ``dropped_frames`` loses each
    with a probability, so that the last one that came is seen again.

    Args:
        kind: ``delay``, ``dropped_frames``, or another, which changes nothing here.
        strength: 1 is 50 ms, or a tenth of the observations; 0 nothing.
    """

    def __init__(self, controller: Controller, spec: PolicySpec, kind: str, strength: float) -> None:
        self._controller, self.fresh, self.origin = controller, False, Origin("")
        self._names = [tensor.name for tensor in spec.inputs]
        self._delay = max(1, round(DELAY_S * strength * spec.rate)) if kind == DELAY and strength else 0
        self._lost = min(MAX_DROPPED_SHARE, DROPPED_SHARE * strength) if kind == DROPPED_FRAMES else 0.0
        self._forget(None)

    def _forget(self, seed: int | None) -> None:
        self._random = np.random.default_rng((seed or 0, 31))
        self._observed: deque[Mapping[str, Any]] = deque(maxlen=self._delay + 1)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of the controller for what it is given at the step at which this was observed."""
        if self._delay or self._lost:
            if not self._observed or self._random.random() >= self._lost:
                self._observed.append({name: _copy(observation[name]) for name in self._names if name in observation})
            observation = self._observed[0]
        action, self.fresh = self._controller.act(observation), self._controller.fresh
        self.origin = origin_of(self._controller)
        return action

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; all policies lose the same observations of the same seed."""
        self._forget(seed)
        self._controller.reset(seed)


def _copy(value: Any) -> Any:
    """Return a value that the environment cannot change afterwards."""
    return value if isinstance(value, str) else copy.deepcopy(value)
