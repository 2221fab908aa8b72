"""Magnitude pruning: the smallest weights become zero."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from vlatool.prune._sparse import Sparse

if TYPE_CHECKING:
    from torch import Tensor


class Magnitude(Sparse):
    """Set the smallest weights of each layer to zero (Han et al., arXiv 1506.02626).

    Shapes stay: processors multiply zeros like other numbers, so that nothing is faster there. It is here to compare
    with, and for sparse tensor cores (--pattern 2:4).
    """

    looks: ClassVar[bool] = False

    def sparse(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return the weight without its smallest values."""
        return weight.masked_fill(self.goes(weight.abs(), rows=False), 0)
