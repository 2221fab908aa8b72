"""Mean absolute error of continuous actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor


class L1:
    """Mean absolute difference of the action chunks, as the graph gives them (normalised)."""

    def __call__(self, student: Tensor, teacher: Tensor) -> Tensor:
        """Return the mean over a batch of chunks (B, ...)."""
        loss: Tensor = require("torch", "build").nn.functional.l1_loss(student, teacher)
        return loss
