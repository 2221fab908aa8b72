"""Observations that a gate calls both bundles with, drawn anew each time, from recordings where there are any."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.data import (
    Drawer,
    Drawn,
    NamedRecording,
    Recording,
    calibration_recording,
    read_recording,
    recordings_of,
    save_drawn,
)
from vlatool.files.scratch import scratch_directory

TIMING, AGREEMENT, MEMORY = range(3)
"""Purposes, each of which draws observations of its own."""
LARGEST = 128_000_000
"""Bytes of the observations of one process; fewer are drawn where each is large."""
MIN_OBSERVATIONS = 8


@dataclass(frozen=True)
class Inputs:
    """Observations for the processes of a gate; nothing of them is the candidate's.

    Args:
        baseline: bundle whose spec, vocabulary, statistics and recordings are drawn from.
        data: further recorded observations, named in the gate file.
        seed: seed of all draws; the observations of each process are its own.
    """

    baseline: Bundle
    data: Path | NamedRecording | None
    seed: int

    @cached_property
    def recordings(self) -> tuple[Recording, ...]:
        """All recordings that are drawn from; raises DataError when one cannot be read or does not fit the spec."""
        spec = self.baseline.manifest.spec
        own = recordings_of(self.baseline).evaluation
        recordings = [read_recording(path, spec) for path in (self.data, own) if path is not None]
        calibration = calibration_recording(self.baseline)
        return (*recordings, *([calibration] if calibration is not None else []))

    @cached_property
    def _drawer(self) -> Drawer:
        return Drawer(self.baseline, self.recordings)

    def draw(self, count: int, purpose: int, number: int = 0) -> list[Drawn]:
        """Return observations for a process; the same for the same seed, purpose and number."""
        random = np.random.default_rng([self.seed, purpose, number])
        first = self._drawer.draw(min(count, MIN_OBSERVATIONS), random)
        size = max(1, *(sum(np.asarray(value).nbytes for value in one.observation.values()) for one in first))
        return first + self._drawer.draw(max(0, min(count, LARGEST // size) - len(first)), random)

    @contextlib.contextmanager
    def file(self, count: int, purpose: int, number: int = 0) -> Iterator[Path]:
        """Yield a file of observations for a process, and remove it in the end."""
        with scratch_directory() as folder:
            path = folder / "observations.npz"
            save_drawn(path, self.draw(count, purpose, number))
            yield path

    def description(self) -> str:
        """Return in words what the observations are drawn from, and how to draw them again."""
        count = sum(map(len, self.recordings))
        source = f"from {count} recorded ones and the vocabulary" if count else "from the spec alone: none is recorded"
        return f"observations are drawn {source} with the seed {self.seed}; --seed {self.seed} draws them again"
