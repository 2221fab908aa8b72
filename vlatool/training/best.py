"""The best weights of a training by its score, and early stopping."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


class Best:
    """The scores of the averaged weights over time, and the best weights.

    Of weights that do equally well the later are kept: they were trained longer.
    """

    def __init__(self) -> None:
        self.scores: list[float] = []
        self.step = 0
        self.weights: dict[str, Tensor] = {}

    @classmethod
    def of(cls, text: str, weights: dict[str, Tensor]) -> Best:
        """Return what ``text`` said, with the weights that were kept beside it."""
        best, about = cls(), json.loads(text)
        best.scores, best.step, best.weights = about["scores"], about["step"], weights
        return best

    def text(self) -> str:
        """Return all but the weights as JSON."""
        return json.dumps({"scores": self.scores, "step": self.step})

    def look(self, score: float, step: int, weights: Mapping[str, Tensor]) -> None:
        """Remember a score, and the weights where none did better; more is better."""
        if not self.scores or score >= max(self.scores):
            self.step = step
            self.weights = {name: value.detach().clone() for name, value in weights.items()}
        self.scores.append(score)

    def rounds_without_improvement(self, number: int) -> int:
        """Return how many of the first scores follow the last one that was better than all before it."""
        scores = self.scores[:number]
        return number - 1 - scores.index(max(scores))
