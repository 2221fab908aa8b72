"""Play an action chunk one control step at a time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.policy import Policy


class ChunkQueue:
    """Gives one action for each control step and infers when the executed part of the chunk is used up.

    Args:
        policy: The policy to ask.
        execute: Actions taken from each chunk; the spec's ``execute`` (or the whole chunk) when 0.
    """

    def __init__(self, policy: Policy, execute: int = 0) -> None:
        self.policy = policy
        self.execute = execute or policy.spec.execute or policy.spec.chunk
        self._pending: list[NDArray[Any]] = []

    def act(self, observation: Mapping[str, Any]) -> NDArray[Any]:
        """Return the action of this control step: (A,) float32, or a 0-d int64 index of a discrete action.

        The observation is read only when a new chunk is needed.
        """
        if not self._pending:
            self._pending = list(self.policy.infer(observation).chunk[: self.execute])
        return np.asarray(self._pending.pop(0))

    def reset(self) -> None:
        """Forget the pending actions and what the policy carries from step to step."""
        self._pending = []
        self.policy.reset()
