"""Huber loss of continuous actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor


class Huber:
    """Squared difference of the action chunks where it is small, absolute where it is large.

    P. J. Huber, "Robust estimation of a location parameter", 1964.

    Args:
        delta: difference above which it is absolute, in units of the graph's (normalised) action.
    """

    def __init__(self, delta: float = 0.1) -> None:
        self._delta = delta

    def __call__(self, student: Tensor, teacher: Tensor) -> Tensor:
        """Return the mean over a batch of chunks (B, ...)."""
        loss: Tensor = require("torch", "build").nn.functional.huber_loss(student, teacher, delta=self._delta)
        return loss
