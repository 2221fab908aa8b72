"""Which rows a step learns from, and which of them this process takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.training.frames import Frames
from vlatool.training.group import Group
from vlatool.training.lesson import Lesson
from vlatool.training.mixture import Draw, Mixture, Part
from vlatool.training.supervision import Supervision

if TYPE_CHECKING:
    from torch import Tensor


class Batches:
    """Draws the rows of a step: the same batch, however many processes share it and in however many parts.

    Args:
        loss: Rows, name -> (B, ...) -> the mean of their losses.
        frames: All rows.
        size: Rows of a batch.
        accumulate: Parts that a process computes one after the other.
        group: Which process this is.
    """

    def __init__(
        self, loss: Callable[[Mapping[str, Any]], Tensor], frames: Frames, size: int, accumulate: int, group: Group
    ) -> None:
        self._of_rows, self._frames, self._size = loss, frames, size
        self._parts = group.size * accumulate
        self._own = slice(group.rank * accumulate, (group.rank + 1) * accumulate)

    def __call__(self, random: np.random.Generator) -> Iterator[Part]:
        """Yield this process's parts of the batch that the random numbers choose."""
        rows = random.integers(len(self._frames), size=self._size)
        for part in np.array_split(rows, self._parts)[self._own]:
            yield len(part) / self._size, partial(self._loss, part)

    def _loss(self, rows: NDArray[Any]) -> Tensor:
        return self._of_rows(self._frames.batch(rows))


def draw_of(lesson: Lesson, supervision: Supervision, frames: Frames, expert: Frames, size: int, accumulate: int,
            group: Group) -> Draw:  # fmt: skip
    """Return what draws the batches of a lesson: of what the teacher labelled, of what an expert did, or of both.

    The rows of the teacher's batches are the same whether there is an expert or not.

    Args:
        lesson: What is learnt.
        supervision: How much each of them counts.
        frames: What the teacher labelled.
        expert: What the expert did.
        size, accumulate, group: As of ``Batches``.
    """
    taught = Batches(lesson.loss, frames, size, accumulate, group)
    if lesson.expert is None:
        return taught
    shown = Batches(lesson.expert, expert, size, accumulate, group)
    alpha = supervision.alpha
    return Mixture([(alpha, taught), (1 - alpha, shown)]) if alpha else shown
