"""A loss of several terms, each with its share and with batches of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Part = tuple[float, Callable[[], "Tensor"]]
"""Share of a batch, and what computes the mean loss of its rows; gradients of parts are added."""
Draw = Callable[[np.random.Generator], Iterable[Part]]
"""Random numbers of a step -> the parts of its batch that this process takes."""


class Mixture:
    """Draws the parts of all terms, one after the other; a term has a share of the loss and draws its batch."""

    def __init__(self, terms: Sequence[tuple[float, Draw]]) -> None:
        self.terms: tuple[Draw, ...] = tuple(_Term(share, draw) for share, draw in terms)

    def __call__(self, random: np.random.Generator) -> Iterator[Part]:
        """Yield the parts of a step."""
        for term in self.terms:
            yield from term(random)


class _Term:
    """One of the terms, each part with its share of the whole loss."""

    def __init__(self, share: float, draw: Draw) -> None:
        self._share, self._draw = share, draw

    def __call__(self, random: np.random.Generator) -> Iterator[Part]:
        for part, compute in self._draw(random):
            yield self._share * part, compute
