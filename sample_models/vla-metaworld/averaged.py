"""What every policy on these tasks is trained by: the optimiser loop, and averaged weights."""

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from batches import Batches, Budget, rate_at
from safetensors.torch import save_file
from torch import Tensor, nn

WEIGHT_DECAY = 0.02
AVERAGE_DECAY = 0.998
LATE_STEP_WEIGHT = 0.5


class AveragedLearner:
    """Trains a policy and keeps an exponential average of its weights; what derives from it says what the loss is.

    `groups` are parameters with their highest learning rate: dicts of `params` and `peak`.
    """

    def __init__(self, policy: nn.Module, groups: list[dict[str, Any]], budget: Budget) -> None:
        self.policy = policy
        self.average = copy.deepcopy(policy).requires_grad_(False)
        self.budget = budget
        self.step = 0
        self.curve: list[tuple[int, float, float]] = []
        self._optimiser = torch.optim.AdamW(groups, betas=(0.9, 0.95), weight_decay=WEIGHT_DECAY, fused=True)
        weights = torch.ones(8)
        weights[4:] = LATE_STEP_WEIGHT
        self._step_weights = (weights / weights.mean())[:, None]

    def run(
        self,
        batches: Batches,
        until: float,
        report: Callable[[int, float], None],
        after_step: Callable[[], None] = lambda: None,
    ) -> None:
        """Trains until the share `until` of the budget is used."""
        self.policy.train()
        losses: list[float] = []
        while self.budget.progress(self.step) < until:
            losses.append(self._update(batches))
            if self.step % 50 == 0:
                self.curve.append((self.step, self.elapsed() / 60.0, float(np.mean(losses))))
                report(self.step, self.curve[-1][2])
                losses.clear()
            after_step()

    def _update(self, batches: Batches) -> float:
        rate = rate_at(self.step, self.budget.progress(self.step))
        for group in self._optimiser.param_groups:
            group["lr"] = group["peak"] * rate
        loss = self._loss(batches)
        self._optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
        self._optimiser.step()
        self.step += 1
        keep = min(AVERAGE_DECAY, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.policy.parameters()), 1.0 - keep)
        return loss.item()

    def _loss(self, batches: Batches) -> Tensor:
        """Returns the loss of the next batch, a scalar."""
        raise NotImplementedError

    def elapsed(self) -> float:
        """Seconds since the training began."""
        return time.monotonic() - self.budget.started

    def save(self, path: Path) -> None:
        """Writes the averaged weights as float16 safetensors."""
        state = {name: value.half().contiguous() for name, value in self.average.state_dict().items()}
        save_file(state, path)
