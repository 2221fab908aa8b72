"""Supervised learning of the policy: the optimiser loop and averaged weights."""

import copy
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from batches import Batches, Budget, rate_at
from policy import VlaPolicy
from safetensors.torch import save_file

LEARNING_RATE = 4e-4
WEIGHT_DECAY = 0.02
AVERAGE_DECAY = 0.998
LATE_STEP_WEIGHT = 0.5


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
        rate = LEARNING_RATE * rate_at(self.step, self.budget.progress(self.step))
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
