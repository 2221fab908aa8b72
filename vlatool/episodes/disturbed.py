"""Disturbances that the evaluation makes itself, for any environment: observations that come late, or not at all."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec

DELAY, DROPPED = "delay", "dropped_frames"
OWN = (DELAY, DROPPED)
DELAY_S = 0.05
"""How old an observation is at strength 1: a camera's exposure, transfer and decoding; one control step at least."""
DROPPED_SHARE, MOST_DROPPED = 0.1, 0.9
"""How many observations are lost at strength 1, and at most."""


class Seen:
    """What of an episode's observations reaches the policy.

    ``delay`` gives each observation some control steps late, the first one until then; ``dropped_frames`` loses each
    with a probability, so that the last one that came is seen again.

    Args:
        spec: Names the inputs and the control rate.
        kind: ``delay``, ``dropped_frames``, or another, which changes nothing here.
        strength: 1 is 50 ms, or a tenth of the observations; 0 nothing.
        seed: Of the episode, so that every policy loses the same observations.
    """

    def __init__(self, spec: PolicySpec, kind: str, strength: float, seed: int) -> None:
        self._names = [tensor.name for tensor in spec.inputs]
        self._random = np.random.default_rng((seed, 31))
        late = max(1, round(DELAY_S * strength * spec.control_hz)) if kind == DELAY and strength else 0
        self._lost = min(MOST_DROPPED, DROPPED_SHARE * strength) if kind == DROPPED else 0.0
        self._kept: deque[Mapping[str, Any]] = deque(maxlen=late + 1)
        self._changes = bool(late or self._lost)

    def __call__(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what the policy sees at the step at which this was observed."""
        if not self._changes:
            return observation
        if not self._kept or self._random.random() >= self._lost:
            self._kept.append({name: _copy(observation[name]) for name in self._names if name in observation})
        return self._kept[0]


def _copy(value: Any) -> Any:
    """Return a value that the environment cannot change afterwards."""
    return value if isinstance(value, str) else copy.deepcopy(value)
