"""How much the answer of a policy depends on the noise that its program draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import VlatoolError
from vlatool.runtime.anomaly import Scale
from vlatool.runtime.interface import Array
from vlatool.runtime.policy import BundlePolicy
from vlatool.runtime.program import draw

LOOK_PERIOD = 20
"""Control steps without an inference of their own between two looks."""


class NoiseSpread:
    """Root mean square difference of two chunks from the same observation with other noise, in standard deviations.

    It infers twice, with the deadline of the control step, and leaves the policy as it was.

    Args:
        policy: What infers, the deadline included.
        bundle: The open bundle inside it.
        state: What of these layers has ``snapshot`` and ``restore``: the bundle, or what runs its two parts.
        limit: Score above which it raises an alarm.
        scale: Statistics of the action; its own units without.
    """

    name = "spread"

    def __init__(self, policy: Any, bundle: BundlePolicy, state: Any, limit: float, scale: Scale | None) -> None:
        self.limit = limit
        self._policy, self._state = policy, state
        self._deviation = np.array(1.0 if scale is None else scale.deviation)
        self._noise = {name: entry for step in bundle.program.steps for name, entry in step.noise.items()}
        self._steps = 0

    @classmethod
    def of(cls, layers: Sequence[Any], limit: float, spec: PolicySpec) -> NoiseSpread | None:
        """Return that of a policy that draws noise and whose inputs are of one moment; None for others."""
        bundle, player = layers[-1], next((layer for layer in layers if hasattr(layer, "policy")), None)
        looks_back = any(tensor.history for tensor in spec.inputs)
        if not isinstance(bundle, BundlePolicy) or player is None or looks_back or spec.action.kind == "discrete":
            return None
        state = next(layer for layer in layers if hasattr(layer, "restore"))
        found = cls(player.policy, bundle, state, limit, Scale.of(spec.action, bundle.bundle))
        return found if found._noise else None

    def score(self, observation: Mapping[str, Any]) -> float | None:
        """Return the difference, at each ``LOOK_PERIOD``-th call; None at others, and where there is no time for it."""
        self._steps += 1
        if self._steps % LOOK_PERIOD:
            return None
        return self.measure(observation, (2 * self._steps, 2 * self._steps + 1))

    def measure(self, observation: Mapping[str, Any], seeds: tuple[int, int]) -> float | None:
        """Return the difference between the chunks of two seeds; None where an inference fails or is late."""
        before = self._state.snapshot
        try:
            one, other = (self._policy.infer(observation, noise=self._drawn(seed)).chunk for seed in seeds)
        except VlatoolError:
            return None
        finally:
            self._state.restore(before)
        return float(np.sqrt(np.mean(((one - other) / self._deviation) ** 2)))

    def _drawn(self, seed: int) -> dict[str, Array]:
        random = np.random.default_rng(seed)
        return {name: draw(entry, random) for name, entry in self._noise.items()}
