"""SparseGPT: weights become zero, and those that stay make up for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.errors import require
from vlatool.prune._sparse import PATTERNS, Sparse

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 128
"""Columns whose weights are chosen together."""
DAMPING = 0.01
"""Share of the mean of the diagonal that is added to it, as in the authors' code."""


class SparseGpt(Sparse):
    """Set weights to zero and correct those that stay by the second order of the layer's error.

    Frantar and Alistarh, arXiv 2301.00774, algorithm 1. Shapes stay: processors multiply zeros like other numbers, so
    that nothing is faster there.
    """

    def sparse(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return the weight without some of its values, the others corrected."""
        torch = require("torch", "build")
        size = weight.shape[1]
        gram = torch.eye(size, dtype=torch.float64) if given is None else given.clone()
        gram += DAMPING * gram.diagonal().mean().clamp(min=1e-12) * torch.eye(size, dtype=torch.float64)
        inverse = torch.linalg.cholesky(torch.cholesky_inverse(torch.linalg.cholesky(gram)), upper=True)
        left = weight.double().clone()
        for start in range(0, size, BLOCK):
            end = min(size, start + BLOCK)
            errors = self._block(left[:, start:end], inverse[start:end, start:end])
            left[:, end:] -= errors @ inverse[start:end, end:]
        return left.to(weight.dtype)

    def _block(self, weight: Tensor, inverse: Tensor) -> Tensor:
        """Prune some columns in place; return the error of each, which later columns make up for."""
        torch = require("torch", "build")
        scale = inverse.diagonal()
        errors: Tensor = torch.zeros_like(weight)
        _, of = PATTERNS.get(self.pattern, (0, weight.shape[1]))
        for column in range(weight.shape[1]):
            if column % of == 0:
                near = slice(column, column + of)
                gone = self.goes((weight[:, near] / scale[near]) ** 2, rows=False)
            kept = weight[:, column].masked_fill(gone[:, column % of], 0)
            errors[:, column] = (weight[:, column] - kept) / scale[column]
            weight[:, column:] -= errors[:, column, None] * inverse[column, column:]
            weight[:, column] = kept
        return errors
