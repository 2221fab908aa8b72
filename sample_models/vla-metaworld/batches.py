"""What every policy on these tasks learns from: augmented batches, and a budget of steps and minutes."""

import ctypes
import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import environment as tasks
import numpy as np
import torch
from demonstrations import Frames
from runtime import Normaliser, tokenise
from torch import Tensor

BATCH = 64
FINAL_RATE = 0.02
WARM_UP_STEPS = 200
MISMATCH_SHARE = 0.15
SHIFT_PIXELS = 3
HOLD_STILL = np.zeros(4, np.float32)


@dataclass
class Budget:
    """When training ends: after `steps` optimiser steps, or earlier when `minutes` since `started` have passed."""

    steps: int
    minutes: float
    started: float = field(default_factory=time.monotonic)

    def progress(self, step: int) -> float:
        """Share of the budget that is used up, 0..1."""
        elapsed = (time.monotonic() - self.started) / 60.0
        return min(1.0, max(step / self.steps, elapsed / self.minutes))


def reuse_large_buffers() -> None:
    """Keeps freed memory inside the process (glibc only): page faults otherwise cost a third of a training step."""
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return
    m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
    libc.mallopt(m_mmap_max, 0)
    libc.mallopt(m_trim_threshold, 2**31 - 1)
    libc.mallopt(m_top_pad, 2**28)


class Batches:
    """Draws augmented training batches from labelled frames."""

    def __init__(self, frames: Frames, vocabulary: dict[str, Any], statistics: dict[str, Any], seed: int) -> None:
        self.frames = frames
        self._generator = np.random.default_rng([seed, len(frames)])
        self._proprio, self._action = Normaliser(statistics["proprio"]), Normaliser(statistics["action"])
        self._ids = [[tokenise(words, vocabulary) for words in wordings] for wordings in tasks.INSTRUCTIONS.values()]
        scenes = [name.split("-")[0] for name in tasks.TASKS]
        self._misfits = [[i for i, other in enumerate(scenes) if other != scene] for scene in scenes]

    @classmethod
    def read(cls, frames: Frames, folder: Path, seed: int) -> "Batches":
        """Takes vocabulary.json and statistics.json of a folder."""
        vocabulary, statistics = (
            json.loads((folder / f"{name}.json").read_text()) for name in ("vocabulary", "statistics")
        )
        return cls(frames, vocabulary, statistics, seed)

    @property
    def state(self) -> dict[str, Any]:
        """Where the generator is, and over how many frames."""
        return {"frames": len(self.frames), "generator": self._generator.bit_generator.state}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on where a generator over as many frames was; the state of another one is ignored."""
        if state["frames"] == len(self.frames):
            self._generator.bit_generator.state = state["generator"]

    def draw(self, size: int = BATCH) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Image (B, 96, 96, 3), proprio (B, 4), ids (B, 8) and target (B, 8, 4), the latter two normalised."""
        index = self._generator.integers(len(self.frames), size=size)
        batch = self.frames.select(index)
        told = batch.task.copy()
        target = batch.action.copy()
        for row in np.flatnonzero(self._generator.random(size) < MISMATCH_SHARE):
            told[row] = self._generator.choice(self._misfits[batch.task[row]])
            target[row] = HOLD_STILL
        ids = np.stack([self._ids[task][self._generator.integers(len(self._ids[task]))] for task in told])
        arrays = (
            self._shift(batch.image),
            self._proprio.normalise(batch.proprio),
            ids,
            self._action.normalise(target),
        )
        image, proprio, words, actions = (torch.from_numpy(array) for array in arrays)
        return image, proprio, words, actions

    def _shift(self, image: np.ndarray) -> np.ndarray:
        """Moves each image by up to `SHIFT_PIXELS`, repeating the border."""
        size = image.shape[1]
        padded = np.pad(image, ((0, 0), (SHIFT_PIXELS,) * 2, (SHIFT_PIXELS,) * 2, (0, 0)), mode="edge")
        offsets = self._generator.integers(2 * SHIFT_PIXELS + 1, size=(len(image), 2))
        return np.stack([one[y : y + size, x : x + size] for one, (y, x) in zip(padded, offsets, strict=True)])


def rate_at(step: int, progress: float) -> float:
    """Linear warm-up, then a cosine from 1 to `FINAL_RATE` over the budget."""
    cosine = FINAL_RATE + (1.0 - FINAL_RATE) * 0.5 * (1.0 + math.cos(math.pi * progress))
    return cosine * min(1.0, (step + 1) / WARM_UP_STEPS)
