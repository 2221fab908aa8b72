"""SparseGPT: weights become zero, and the remaining ones compensate."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.errors import require
from vlatool.prune._sparse_base import PATTERNS, SparsePruning

if TYPE_CHECKING:
    from torch import Tensor

BLOCK_COLUMNS = 128
"""Columns whose weights are chosen together."""
DAMPING = 0.01
"""Share of the mean of the diagonal that is added to it, as in the authors' code."""


class SparseGpt(SparsePruning):
    """Set weights to zero and correct the remaining ones by the second order of the layer's error.

    Frantar and Alistarh, arXiv 2301.00774, algorithm 1. Shapes stay: CPUs multiply zeros like other numbers, so nothing
    is faster there.
    """

    def prune_weight(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return the weight with zeros, the other values corrected."""
        torch = require("torch", "build")
        size = weight.shape[1]
        gram = torch.eye(size, dtype=torch.float64) if given is None else given.clone()
        gram += DAMPING * gram.diagonal().mean().clamp(min=1e-12) * torch.eye(size, dtype=torch.float64)
        inverse = torch.linalg.cholesky(torch.cholesky_inverse(torch.linalg.cholesky(gram)), upper=True)
        left = weight.double().clone()
        for start in range(0, size, BLOCK_COLUMNS):
            end = min(size, start + BLOCK_COLUMNS)
            errors = self._prune_block(left[:, start:end], inverse[start:end, start:end])
            left[:, end:] -= errors @ inverse[start:end, end:]
        return left.to(weight.dtype)

    def _prune_block(self, weight: Tensor, inverse: Tensor) -> Tensor:
        """Prune some columns in place; return the error of each, which later columns compensate."""
        torch = require("torch", "build")
        scale = inverse.diagonal()
        errors: Tensor = torch.zeros_like(weight)
        _, of = PATTERNS.get(self.pattern, (0, weight.shape[1]))
        for column in range(weight.shape[1]):
            if column % of == 0:
                near = slice(column, column + of)
                gone = self.pruned_mask((weight[:, near] / scale[near]) ** 2, rows=False)
            kept = weight[:, column].masked_fill(gone[:, column % of], 0)
            errors[:, column] = (weight[:, column] - kept) / scale[column]
            weight[:, column:] -= errors[:, column, None] * inverse[column, column:]
            weight[:, column] = kept
        return errors
