"""Kullback-Leibler divergence of discrete actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor


class Kl:
    """Divergence of the student's distribution over labels from the teacher's, times the temperature squared.

    Hinton, Vinyals and Dean, "Distilling the knowledge in a neural network", arXiv 1503.02531, section 2: the factor
    keeps the size of the gradient whatever the temperature.

    Args:
        temperature: both are softened by it; 1 for the policy's own probabilities.
    """

    def __init__(self, temperature: float = 2.0) -> None:
        self._temperature = temperature

    def __call__(self, student: Tensor, teacher: Tensor) -> Tensor:
        """Return the mean over a batch of logits (B, ..., labels)."""
        functional = require("torch", "build").nn.functional
        ours = functional.log_softmax(student / self._temperature, dim=-1)
        theirs = functional.log_softmax(teacher / self._temperature, dim=-1)
        rows = functional.kl_div(ours, theirs, reduction="none", log_target=True).sum(dim=-1)
        loss: Tensor = rows.mean() * self._temperature**2
        return loss
