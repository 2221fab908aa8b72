"""A policy that keeps a count from step to step, to tell the episodes of several clients from each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec
from vlatool.runtime.interface import Action


class CountingPolicy(NumberedPolicy):
    """Adds the number of its inferences since the last reset to each element of a chunk, in thousandths."""

    def __init__(self, spec: PolicySpec | None = None) -> None:
        super().__init__(spec_of(chunk=3, execute=2) if spec is None else spec)
        self.count = 0

    @property
    def snapshot(self) -> int:
        """The count."""
        return self.count

    def restore(self, snapshot: int) -> None:
        """Take the count back."""
        self.count = snapshot

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; the seed is added to the count."""
        super().reset(seed)
        self.count = seed or 0

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        """Return a chunk with the count in it."""
        action = super().infer(observation, noise=noise)
        self.count += 1
        return action._replace(chunk=action.chunk + self.count / 1000, sequence=self.count)
