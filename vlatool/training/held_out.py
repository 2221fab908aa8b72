"""Held-out recorded observations: without episodes, their loss decides when to stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data import Recording
from vlatool.errors import DataError
from vlatool.training.batches import Loss, mean_loss
from vlatool.training.device import Device
from vlatool.training.expert import Expert
from vlatool.training.frames import Frames
from vlatool.training.rounds import Observations, next_round

if TYPE_CHECKING:
    from torch import Tensor

FOLDER = "held-out"
SHARE = 0.1
"""Share of the episodes, or of the stretches where episodes are not recorded, that is held out."""
STRETCHES = 20
"""Parts of a recording without episodes: neighbours look alike, and stay together."""


class HeldOut:
    """The recorded observations in two parts: one for training, one held out.

    Args:
        frames: folder -> the rounds in it, as the objective takes them.
    """

    def __init__(self, folder: Path, frames: Callable[[Path], Frames] = Frames) -> None:
        self._frames = frames(folder / FOLDER)
        self.expert = Expert(folder / FOLDER, frames)
        self.recording: Recording | None = None
        """The held-out part, after ``prepare``."""
        self._training_part: Observations | None = None

    @property
    def training_part(self) -> Observations:
        """Return the observations for training."""
        if self._training_part is None:
            raise RuntimeError("prepare() comes first")
        return self._training_part

    def prepare(
        self, recording: Recording | None, write: Callable[[Observations, Path], None], other: Callable[[Path], bool]
    ) -> None:
        """Split the recording, and write what is held out unless an earlier run did.

        Args:
            write: function called with observations and the folder for them.
            other: called with the folder where there are not two observations to split; says whether it wrote others.

        Raises:
            DataError: when there are not two observations to split.
        """
        if recording is None or len(recording) < 2:
            self._training_part = [] if recording is None else recording
            next_round(self._frames, 0, partial(_write_required, other, len(self._training_part)))
            return
        held = held_out_mask(recording)
        self._training_part = recording.subset(~held)
        self.recording = recording.subset(held)
        next_round(self._frames, 0, partial(write, self.recording))

    def read(self) -> None:
        """Use what another process holds out."""
        self._frames.read(0)
        self.expert.read()

    def loss(self, loss: Callable[[Mapping[str, Any]], Tensor], rows: int, device: Device) -> float:
        """Return the mean loss of the held-out part."""
        return mean_loss(self._frames, self._frames.sample((0,), len(self._frames)), loss, rows, device)

    def mixture_loss(self, alpha: float, loss: Loss, expert: Loss | None, rows: int, device: Device) -> float:
        """Return the mean loss of the held-out part as a mixture of both terms.

        Args:
            alpha: share of the teacher.
            loss: loss of a batch, against the teacher.
            expert: loss of a batch, against the expert's actions; None where no expert is asked.
        """
        total = alpha * self.loss(loss, rows, device) if alpha else 0.0
        if expert is None:
            return total
        shown = self.expert.frames
        return total + (1 - alpha) * mean_loss(shown, shown.sample((0,), len(shown)), expert, rows, device)


def _write_required(fallback: Callable[[Path], bool], recorded: int, target: Path) -> None:
    if not fallback(target):
        raise DataError(
            f"--patience needs something to judge with: episodes of the student's, or two recorded observations; "
            f"there are {recorded}.",
            "record some (calibration: FILE.npz in policy.yaml), name an environment or a function that yields batches "
            "there (training: train.py:batches), or omit --patience",
        )


def held_out_mask(recording: Recording) -> NDArray[np.bool_]:
    """Return the mask of held-out observations: whole episodes where there are two or more, else stretches."""
    size = len(recording)
    groups = recording.episodes
    if groups is None or len(np.unique(groups)) < 2:
        groups = np.arange(size) * min(STRETCHES, size) // size
    names, firsts = np.unique(groups, return_index=True)
    ordered = names[np.argsort(firsts)]
    count = max(1, round(len(ordered) * SHARE))
    indices = np.linspace(0, len(ordered) - 1, count + 2)[1:-1].round().astype(int) if len(ordered) > 2 else [1]
    return np.isin(groups, ordered[indices])
