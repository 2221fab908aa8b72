"""Wanda: weights of least magnitude times norm of their inputs become zero."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.prune._sparse_base import SparsePruning

if TYPE_CHECKING:
    from torch import Tensor


class Wanda(SparsePruning):
    """Set the weights of least |weight| x norm of their input to zero, row by row (Sun et al., arXiv 2306.11695).

    Shapes stay: CPUs multiply zeros like other numbers, so nothing is faster there.
    """

    def prune_weight(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return the weight with its least important values set to zero."""
        score = weight.abs() if given is None else weight.abs().double() * given.diagonal().clamp(min=0).sqrt()
        return weight.masked_fill(self.pruned_mask(score, rows=True), 0)
