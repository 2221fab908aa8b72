"""Constraints on the weights after every step of a training."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor


class Constraint:
    """No constraint; base of the others.

    A run that is killed goes on from the weights alone: what is done in a step may depend on them and its number only.
    """

    @contextlib.contextmanager
    def step(self, number: int) -> Iterator[None]:
        """Surround an update of the weights; ``number`` counts from 1 on."""
        yield

    def average(self, weight: Tensor, average: Tensor) -> None:
        """Change the average of a weight in place, after it followed."""


class KeptZeros(Constraint):
    """Zeros stay zero.

    Zeros are their own mask: what is exactly zero before an update is zero after it.

    Args:
        weights: weights that are sparse, (outputs, ...).
    """

    def __init__(self, weights: Sequence[Tensor]) -> None:
        self._weights = list(weights)
        self._known = {id(weight) for weight in weights}

    @contextlib.contextmanager
    def step(self, number: int) -> Iterator[None]:
        """Keep the zeros."""
        zeros = [weight == 0 for weight in self._weights]
        yield
        with require("torch", "build").no_grad():
            for weight, zero in zip(self._weights, zeros, strict=True):
                weight.masked_fill_(zero, 0)

    def average(self, weight: Tensor, average: Tensor) -> None:
        """Give an average the zeros of its weight."""
        if id(weight) in self._known:
            average.masked_fill_(weight == 0, 0)


class GrowingZeros(KeptZeros):
    """Zeros stay zero, and step by step more of the smallest weights become zero.

    Args:
        weights: weights that become sparse, (outputs, ...).
        goes: sizes of the elements of a weight (outputs, inputs), and a share -> which of them are to be zero.
        shares: number of a step -> the share of the elements that are zero after it; steps in which none are added are
            left out.
    """

    def __init__(
        self, weights: Sequence[Tensor], goes: Callable[[Tensor, float], Tensor], shares: dict[int, float]
    ) -> None:
        super().__init__(weights)
        self._goes, self._shares = goes, shares

    @contextlib.contextmanager
    def step(self, number: int) -> Iterator[None]:
        """Keep the zeros, and add some."""
        with super().step(number):
            yield
        with require("torch", "build").no_grad():
            for weight in self._weights if number in self._shares else ():
                sizes = weight.abs().reshape(len(weight), -1)
                weight.masked_fill_(self._goes(sizes, self._shares[number]).reshape(weight.shape), 0)
