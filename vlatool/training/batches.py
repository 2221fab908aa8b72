"""The batches of a training step, and the share of this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import require
from vlatool.training.device import Device
from vlatool.training.frames import Frames
from vlatool.training.group import Group
from vlatool.training.mixture import Draw, Mixture, Part

if TYPE_CHECKING:
    from torch import Tensor


Loss = Callable[[Mapping[str, Any]], "Tensor"]
"""Rows of a batch, name -> (B, ...) -> the mean of their losses."""


class Batches:
    """Draws the rows of a step: the same batch, however many processes share it and in however many parts.

    Args:
        loss: rows, name -> (B, ...) -> the mean of their losses.
        accumulate: parts that a process computes one after the other.
    """

    def __init__(
        self, loss: Callable[[Mapping[str, Any]], Tensor], frames: Frames, size: int, accumulate: int, group: Group
    ) -> None:
        self._of_rows, self._frames, self._size = loss, frames, size
        self._parts = group.size * accumulate
        self._own = slice(group.rank * accumulate, (group.rank + 1) * accumulate)

    def __call__(self, random: np.random.Generator) -> Iterator[Part]:
        """Yield this process's parts of the batch that the random numbers choose."""
        indices = self._frames.draw(random, self._size)
        for part in np.array_split(indices, self._parts)[self._own]:
            yield self._frames.row_count(part) / self._frames.row_count(indices), partial(self._loss, part)

    def of(self, loss: Loss, frames: Frames) -> Batches:
        """Return batches of other rows, with another loss, in the same parts."""
        other = copy(self)
        other._of_rows, other._frames = loss, frames
        return other

    def _loss(self, indices: NDArray[Any]) -> Tensor:
        return self._of_rows(self._frames.batch(indices))


def mean_loss(frames: Frames, indices: NDArray[Any], loss: Loss, rows: int, device: Device) -> float:
    """Return the mean loss of rows, without gradients; ``indices`` are as ``Frames.sample`` gives them."""
    total, count = 0.0, frames.row_count(indices)
    with require("torch", "build").no_grad(), device.computing(), device.casting():
        for part in np.array_split(indices, min(len(indices), -(-count // rows))):
            total += float(loss(frames.batch(part))) * frames.row_count(part)
    return total / count


def draw_of(taught: Batches, alpha: float, loss: Loss | None, shown: Frames) -> Draw:
    """Return what draws the batches of a training; the teacher's are the same whether there is an expert or not.

    Args:
        taught: batches of what the teacher labelled.
        alpha: share of the teacher in the loss.
        loss: loss against an expert's actions; None without an expert.
        shown: rows with what the expert did.
    """
    if loss is None:
        return taught
    others = taught.of(loss, shown)
    return Mixture([(alpha, taught), (1 - alpha, others)]) if alpha else others
