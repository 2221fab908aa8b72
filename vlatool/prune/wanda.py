"""Wanda: weights that matter least for what a layer is given become zero."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.prune._sparse import Sparse

if TYPE_CHECKING:
    from torch import Tensor


class Wanda(Sparse):
    """Set the weights of least |weight| x norm of their input to zero, row by row (Sun et al., arXiv 2306.11695).

    Shapes stay: processors multiply zeros like other numbers, so that nothing is faster there.
    """

    def sparse(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return the weight without what its inputs make small."""
        score = weight.abs() if given is None else weight.abs().double() * given.diagonal().clamp(min=0).sqrt()
        return weight.masked_fill(self.goes(score, rows=True), 0)
