"""Recorded observations that a training does not learn from: where nobody plays, their loss says when to stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.data import Recording, calibration_recording
from vlatool.errors import DataError, require
from vlatool.training.expert import Expert
from vlatool.training.frames import Frames
from vlatool.training.lesson import Lesson
from vlatool.training.rounds import Counted, next_round

if TYPE_CHECKING:
    from torch import Tensor

FOLDER = "held-out"
SHARE = 0.1
"""Of the episodes, or of the stretches where episodes are not recorded."""
STRETCHES = 20
"""Parts of a recording without episodes: neighbours look alike, and stay together."""


class HeldOut:
    """The recorded observations in two: one part to learn from, one to judge with.

    Args:
        place: Folder of the training.
    """

    def __init__(self, place: Path) -> None:
        self.frames = Frames(place / FOLDER)
        self.expert = Expert(place / FOLDER)
        self._halves: tuple[Recording, Recording] | None = None

    @property
    def recording(self) -> Recording:
        """Return the observations to judge with."""
        return self._split()[0]

    @property
    def others(self) -> Recording:
        """Return the observations to learn from."""
        return self._split()[1]

    def _split(self) -> tuple[Recording, Recording]:
        if self._halves is None:
            raise RuntimeError("split() comes first")
        return self._halves

    def split(self, source: Bundle, most: int) -> None:
        """Split the recording.

        Args:
            source: The student's bundle.
            most: Observations that are used of it.

        Raises:
            DataError: when there are not two observations to split.
        """
        recording = calibration_recording(source)
        if recording is None or len(recording) < 2:
            raise DataError(
                f"--patience needs something to judge with: episodes of the student's, or two recorded observations; "
                f"there are {len(recording) if recording else 0}.",
                "record some (calibration: FILE.npz in policy.yaml), name an environment there, or omit --patience",
            )
        recording = at_most(recording, most)
        held = held_out(recording)
        self._halves = recording.only(held), recording.only(~held)

    def write(self, write: Callable[[Counted, Path], None]) -> None:
        """Write what is held out unless an earlier run did.

        Args:
            write: Called with observations and the folder for them.
        """
        next_round(self.frames, 0, partial(write, self.recording))

    def loss(self, lesson: Lesson, alpha: float, rows: int, *, bfloat16: bool) -> float:
        """Return the mean loss of what is held out.

        Args:
            lesson: What is learnt.
            alpha: Share of the teacher in the loss.
            rows: At a time.
            bfloat16: Whether matrix products are computed so, as in training.
        """
        total = alpha * mean_loss(self.frames, lesson.loss, rows, bfloat16=bfloat16) if alpha else 0.0
        if lesson.expert is None:
            return total
        return total + (1 - alpha) * mean_loss(self.expert.frames, lesson.expert, rows, bfloat16=bfloat16)


def at_most(recording: Recording, most: int) -> Recording:
    """Return so many observations of a recording, spread over it, or all."""
    used = np.zeros(len(recording), np.bool_)
    used[recording.spread(most)] = True
    return recording.only(used)


def mean_loss(frames: Frames, loss: Callable[[Mapping[str, Any]], Tensor], rows: int, *, bfloat16: bool) -> float:
    """Return the mean loss of all rows.

    Args:
        frames: The rows.
        loss: Of a batch.
        rows: At a time.
        bfloat16: Whether matrix products are computed so, as in training.
    """
    torch, total = require("torch", "build"), 0.0
    parts = np.array_split(np.arange(len(frames)), -(-len(frames) // rows))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        for part in parts:
            total += float(loss(frames.batch(part))) * len(part)
    return total / len(frames)


def held_out(recording: Recording) -> NDArray[np.bool_]:
    """Say of each observation whether it is held out: whole episodes where there are two or more, else stretches."""
    size = len(recording)
    groups = recording.episodes
    if groups is None or len(np.unique(groups)) < 2:
        groups = np.arange(size) * min(STRETCHES, size) // size
    names, firsts = np.unique(groups, return_index=True)
    ordered = names[np.argsort(firsts)]
    count = max(1, round(len(ordered) * SHARE))
    places = np.linspace(0, len(ordered) - 1, count + 2)[1:-1].round().astype(int) if len(ordered) > 2 else [1]
    return np.isin(groups, ordered[places])
