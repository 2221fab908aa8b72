"""Flow matching: the regression of velocities, and checkpoints."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import neighbor  # noqa: F401
import torch
from averaged import AveragedLearner
from batches import Batches, Budget
from policy import make
from safetensors.torch import load_file
from torch import Tensor, nn

BATCH = 32
LEARNING_RATE = 4e-4
TRUNK_RATE = 1.5e-4
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


class FlowLearner(AveragedLearner):
    """Trains both graphs with bfloat16 autocast; the trunk, which is trained already, more slowly."""

    def __init__(self, seed: int, budget: Budget, trunk: Path) -> None:
        torch.manual_seed(seed)
        policy = nn.ModuleDict(make(None)).to(memory_format=torch.channels_last)
        old = from_trunk(policy, trunk)
        named = list(policy.named_parameters())
        groups = [
            {"params": [value for name, value in named if name in old], "peak": TRUNK_RATE},
            {"params": [value for name, value in named if name not in old], "peak": LEARNING_RATE},
        ]
        super().__init__(policy, groups, budget)

    def train(self, batches: Batches, until: float, report: Callable[[int, float], None], checkpoint: Path) -> None:
        """Trains until the share `until` of the budget is used, and writes checkpoints."""

        def keep() -> None:
            if self.step % CHECKPOINT_EVERY == 0:
                self.checkpoint(checkpoint, batches)

        self.run(batches, until, report, keep)

    def _loss(self, batches: Batches) -> Tensor:
        image, proprio, words, target = batches.draw(BATCH)
        x, t, velocity = draw_flow(target, DRAWS)
        with torch.autocast("cpu", torch.bfloat16):
            context = self.policy["prefix"](image, proprio, words)
            predicted = self.policy["step"].velocity(x, t, context[:, None])
        return ((predicted.float() - velocity).square() * self._step_weights).mean()

    def checkpoint(self, path: Path, batches: Batches) -> None:
        """Writes everything that training goes on from."""
        state = {
            "policy": self.policy.state_dict(), "average": self.average.state_dict(),
            "optimiser": self._optimiser.state_dict(), "random": torch.get_rng_state(), "batches": batches.state,
            "step": self.step, "elapsed": self.elapsed(), "curve": self.curve,
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
