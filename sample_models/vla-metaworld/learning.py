"""Supervised learning of the policy: batches with augmentation, the optimiser loop and averaged weights."""

import copy
import ctypes
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import environment as tasks
import numpy as np
import torch
from demonstrations import Frames
from policy import VlaPolicy
from runtime import Normaliser, tokenise
from safetensors.torch import save_file
from torch import Tensor

BATCH = 64
LEARNING_RATE = 4e-4
FINAL_RATE = 0.02
WARM_UP_STEPS = 200
WEIGHT_DECAY = 0.02
AVERAGE_DECAY = 0.998
MISMATCH_SHARE = 0.15
SHIFT_PIXELS = 3
LATE_STEP_WEIGHT = 0.5
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

    def draw(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Image (B, 96, 96, 3), proprio (B, 4), ids (B, 8) and target (B, 8, 4), the latter two normalised."""
        index = self._generator.integers(len(self.frames), size=BATCH)
        batch = self.frames.select(index)
        told = batch.task.copy()
        target = batch.action.copy()
        for row in np.flatnonzero(self._generator.random(BATCH) < MISMATCH_SHARE):
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


class Learner:
    """Trains the policy with bfloat16 autocast and keeps an exponential average of its weights."""

    def __init__(self, seed: int, budget: Budget) -> None:
        torch.manual_seed(seed)
        self.policy = VlaPolicy().to(memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.policy).requires_grad_(False)
        self.budget = budget
        self.step = 0
        self.curve: list[tuple[int, float, float]] = []
        self._optimiser = torch.optim.AdamW(
            self.policy.parameters(), LEARNING_RATE, betas=(0.9, 0.95), weight_decay=WEIGHT_DECAY, fused=True
        )
        weights = torch.ones(8)
        weights[4:] = LATE_STEP_WEIGHT
        self._step_weights = (weights / weights.mean())[:, None]

    def run(self, batches: Batches, until: float, report: Callable[[int, float], None]) -> None:
        """Trains until the share `until` of the budget is used."""
        self.policy.train()
        losses: list[float] = []
        while self.budget.progress(self.step) < until:
            losses.append(self._update(batches))
            if self.step % 50 == 0:
                minutes = (time.monotonic() - self.budget.started) / 60.0
                self.curve.append((self.step, minutes, float(np.mean(losses))))
                report(self.step, self.curve[-1][2])
                losses.clear()

    def _update(self, batches: Batches) -> float:
        rate = LEARNING_RATE * _schedule(self.step, self.budget.progress(self.step))
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        image, proprio, words, target = batches.draw()
        with torch.autocast("cpu", torch.bfloat16):
            predicted = self.policy(image, proprio, words)
        loss = ((predicted.float() - target).abs() * self._step_weights).mean()
        self._optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
        self._optimiser.step()
        self.step += 1
        keep = min(AVERAGE_DECAY, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.policy.parameters()), 1.0 - keep)
        return loss.item()

    def save(self, path: Path) -> None:
        """Writes the averaged weights as float16 safetensors."""
        state = {name: value.half().contiguous() for name, value in self.average.state_dict().items()}
        save_file(state, path)


def _schedule(step: int, progress: float) -> float:
    """Linear warm-up, then a cosine from 1 to `FINAL_RATE` over the budget."""
    cosine = FINAL_RATE + (1.0 - FINAL_RATE) * 0.5 * (1.0 + math.cos(math.pi * progress))
    return cosine * min(1.0, (step + 1) / WARM_UP_STEPS)
