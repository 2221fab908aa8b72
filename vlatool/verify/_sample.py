"""One observation of a comparison, and how far two actions are apart."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlatool.runtime.interface import Array
from vlatool.runtime.observation import EncodedObservation
from vlatool.runtime.policy import Policy

MAX_ERROR = 1e9


@dataclass(frozen=True)
class Sample:
    """One observation and what both sides made of it.

    Args:
        number: its place in the recording.
        observation: physical values.
        noise: noise that both were given.
        encoded: what this policy's network takes, with a batch axis.
        raw: what its network gives.
        chunk: its action: (T, A) float64, or (T,) int64.
        expected: the original's, the same, as many leading steps as it gives.
        inputs: what the original's network takes, as far as it tells it.
        expected_raw: what that gives, None when it does not tell it.
        error: relative error of the action.
    """

    number: int
    observation: dict[str, Any]
    noise: dict[str, Array]
    encoded: EncodedObservation
    raw: Array
    chunk: Array
    expected: Array
    inputs: dict[str, Array] = field(default_factory=dict)
    expected_raw: Array | None = None
    error: float = 0.0


def error_of(policy: Policy, got: Array, expected: Array) -> float:
    """Return the relative error of an action: by the spread of each element; the share of others where discrete."""
    if policy.spec.action.kind == "discrete":
        return float(np.mean(got != expected))
    return min(policy.chunk_error(got, expected), MAX_ERROR)
