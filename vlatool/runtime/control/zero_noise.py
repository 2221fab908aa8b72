"""A policy that starts from zeros in the place of the noise that it would draw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.runtime.interface import Action, Array, Policy, layers_of, observer_of


class ZeroNoise:
    """Infers with zeros, the mean of all noise that a program draws, instead of a draw for each inference.

    A policy that turns noise into actions (diffusion, flow matching) goes another way with each draw, so that chunks of
    successive inferences do not continue each other. With zeros they differ by what was observed alone. The policy was
    not trained on zeros in particular: measure whether it succeeds as often as before.

    Raises:
        UsageError: when the policy draws no noise.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy, self.spec = policy, policy.spec
        self._observer = observer_of(policy)
        programs = [layer.program for layer in layers_of(policy) if hasattr(layer, "program")]
        steps = [step for program in programs for step in getattr(program, "steps", program)]
        self._zeros = {name: np.zeros(entry["shape"], np.float32)
                       for step in steps for name, entry in step.noise.items()}  # fmt: skip
        if not self._zeros:
            raise UsageError("The policy draws no noise in the place of which there could be zeros.",
                             "leave zero_noise out")  # fmt: skip

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk; ``noise`` replaces the zeros, by name.

        Raises:
            VlatoolError: as the policy's ``infer`` does.
        """
        return self.policy.infer(observation, noise={**self._zeros, **(noise or {})})

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation of a control step at which it does not infer."""
        if self._observer is not None:
            self._observer.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; see ``Policy.reset``."""
        self.policy.reset(seed)
