"""The objective of a training: what a student minimizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.training.constraint import Constraint
from vlatool.training.frames import Frames
from vlatool.training.sequences import Sequences, Unroll

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class Objective:
    """The objective of a training.

    Args:
        modules: the student's, which are trained in place.
        loss: rows of a batch, name -> (B, ...), as ``label`` wrote them -> the mean of their losses: a batch may be
            computed in parts.
        judged: what of it says how good the student is on rows that it has not seen; all of it when None.
        along: name -> module that is trained along, and no part of the student.
        about: what else is to be known of the training, as JSON values.
        expert: the same as ``loss`` for rows as ``Expert`` wrote them; None where no expert is asked.
        unroll: how far the training goes back in time, where the student keeps values; ``loss`` then takes stretches
            of episodes instead of rows.
        turns: whether the teacher also shows single turns of its loop (``rounds.write_labels``).
    """

    name: str
    modules: Mapping[str, nn.Module]
    loss: Callable[[Mapping[str, Any]], Tensor]
    judged: Callable[[Mapping[str, Any]], Tensor] | None = None
    along: Mapping[str, nn.Module] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)
    constraint: Constraint | None = None
    expert: Callable[[Mapping[str, Any]], Tensor] | None = None
    unroll: Unroll | None = None
    turns: bool = False

    def frames(self, folder: Path) -> Frames:
        """Return the rounds in a folder, as ``loss`` takes them."""
        return Frames(folder) if self.unroll is None else Sequences(folder, self.unroll)

    @property
    def validation(self) -> Callable[[Mapping[str, Any]], Tensor]:
        """What says how good the student is."""
        return self.judged or self.loss

    @property
    def trainable(self) -> dict[str, nn.Module]:
        """Everything that is trained."""
        return {**self.modules, **self.along}

    def look(self, frames: Frames, shown: Frames) -> None:
        """Let the programs find out whether their modules take batches, with rows that all processes agree on."""
        for loss, rows in ((self.loss, frames), (self.expert, shown)):
            if loss is not None and len(rows):
                loss(rows.batch(np.arange(2) % len(rows)))
