"""Flow matching: the regression of velocities, the optimiser loop, averaged weights, and checkpoints."""

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import neighbor  # noqa: F401
import numpy as np
import torch
from batches import Batches, Budget, rate_at
from policy import make
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

BATCH = 32
LEARNING_RATE = 4e-4
TRUNK_RATE = 1.5e-4
WEIGHT_DECAY = 0.02
AVERAGE_DECAY = 0.998
LATE_STEP_WEIGHT = 0.5
DRAWS = 4
CHECKPOINT_EVERY = 250


def from_trunk(policy: nn.ModuleDict, folder: Path) -> set[str]:
    """Starts the prefix with what the policy of a folder has under the same names; returns these names."""
    state = policy.state_dict()
    shared = {f"prefix.{name}": value.float() for name, value in load_file(folder / "weights.safetensors").items()}
    shared = {name: value for name, value in shared.items() if name in state}
    policy.load_state_dict(state | shared)
    return set(shared)


def draw_flow(target: Tensor, draws: int) -> tuple[Tensor, Tensor, Tensor]:
    """Actions (B, C, A) -> noisy actions (B, K, C, A), times (B, K) and velocities (B, K, C, A).

    Times near 1, where a chunk is all noise, are drawn more often (Beta(1.5, 1), as in pi0).
    """
    actions = target[:, None].expand(-1, draws, -1, -1)
    noise = torch.randn_like(actions)
    t = torch.rand(len(target), draws) ** (2 / 3) * 0.999 + 0.001
    share = t[..., None, None]
    return share * noise + (1 - share) * actions, t, noise - actions


class FlowLearner:
    """Trains both graphs with bfloat16 autocast and keeps an exponential average of their weights."""

    def __init__(self, seed: int, budget: Budget, trunk: Path) -> None:
        torch.manual_seed(seed)
        self.policy = nn.ModuleDict(make(None)).to(memory_format=torch.channels_last)
        old = from_trunk(self.policy, trunk)
        self.average = copy.deepcopy(self.policy).requires_grad_(False)
        self.budget = budget
        self.step = 0
        self.curve: list[tuple[int, float, float]] = []
        named = list(self.policy.named_parameters())
        groups = [
            {"params": [value for name, value in named if name in old], "peak": TRUNK_RATE},
            {"params": [value for name, value in named if name not in old], "peak": LEARNING_RATE},
        ]
        self._optimiser = torch.optim.AdamW(
            groups, LEARNING_RATE, betas=(0.9, 0.95), weight_decay=WEIGHT_DECAY, fused=True
        )
        weights = torch.ones(8)
        weights[4:] = LATE_STEP_WEIGHT
        self._step_weights = (weights / weights.mean())[:, None]

    def run(self, batches: Batches, until: float, report: Callable[[int, float], None], checkpoint: Path) -> None:
        """Trains until the share `until` of the budget is used."""
        self.policy.train()
        losses: list[float] = []
        while self.budget.progress(self.step) < until:
            losses.append(self._update(batches))
            if self.step % 50 == 0:
                self.curve.append((self.step, self._elapsed() / 60.0, float(np.mean(losses))))
                report(self.step, self.curve[-1][2])
                losses.clear()
            if self.step % CHECKPOINT_EVERY == 0:
                self.checkpoint(checkpoint, batches)

    def _update(self, batches: Batches) -> float:
        rate = rate_at(self.step, self.budget.progress(self.step))
        for group in self._optimiser.param_groups:
            group["lr"] = group["peak"] * rate
        loss = self._loss(*batches.draw(BATCH))
        self._optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
        self._optimiser.step()
        self.step += 1
        keep = min(AVERAGE_DECAY, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.policy.parameters()), 1.0 - keep)
        return loss.item()

    def _loss(self, image: Tensor, proprio: Tensor, words: Tensor, target: Tensor) -> Tensor:
        x, t, velocity = draw_flow(target, DRAWS)
        with torch.autocast("cpu", torch.bfloat16):
            context = self.policy["prefix"](image, proprio, words)
            predicted = self.policy["step"].velocity(x, t, context[:, None])
        return ((predicted.float() - velocity).square() * self._step_weights).mean()

    def _elapsed(self) -> float:
        return time.monotonic() - self.budget.started

    def checkpoint(self, path: Path, batches: Batches) -> None:
        """Writes everything that training goes on from."""
        state = {
            "policy": self.policy.state_dict(), "average": self.average.state_dict(),
            "optimiser": self._optimiser.state_dict(), "random": torch.get_rng_state(), "batches": batches.state,
            "step": self.step, "elapsed": self._elapsed(), "curve": self.curve,
        }  # fmt: skip
        torch.save(state, path.with_suffix(".new"))
        path.with_suffix(".new").replace(path)

    def resume(self, path: Path) -> dict[str, Any] | None:
        """Goes on from a checkpoint, where there is one; returns the state of the batches."""
        if not path.exists():
            return None
        state = torch.load(path, weights_only=False)
        self.policy.load_state_dict(state["policy"])
        self.average.load_state_dict(state["average"])
        self._optimiser.load_state_dict(state["optimiser"])
        torch.set_rng_state(state["random"])
        self.step, self.curve = state["step"], state["curve"]
        self.budget.started = time.monotonic() - state["elapsed"]
        return state["batches"]

    def save(self, path: Path) -> None:
        """Writes the averaged weights as float16 safetensors."""
        state = {name: value.half().contiguous() for name, value in self.average.state_dict().items()}
        save_file(state, path)
