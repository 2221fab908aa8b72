"""Magnitude pruning: the smallest weights become zero."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from vlatool.prune._sparse_base import SparsePruning

if TYPE_CHECKING:
    from torch import Tensor


class Magnitude(SparsePruning):
    """Set the smallest weights of each layer to zero (Han et al., arXiv 1506.02626).

    Shapes stay: CPUs multiply zeros like other numbers, so nothing is faster there. The method is meant as a baseline,
    and for sparse tensor cores (--pattern 2:4).
    """

    uses_inputs: ClassVar[bool] = False

    def prune_weight(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return the weight without its smallest values."""
        return weight.masked_fill(self.pruned_mask(weight.abs(), rows=False), 0)
