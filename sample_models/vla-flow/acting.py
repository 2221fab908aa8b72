"""The policy of a folder, ready to act on raw observations; `neighbor` must have been imported before."""

from pathlib import Path

import torch
from policy import ACTION_DIM, CHUNK, STEPS, make
from runtime import Runner
from torch import Tensor, nn


class Sampler(nn.Module):
    """Both graphs as one module: draws noise, and takes `steps` Euler steps from it."""

    def __init__(self, graphs: dict[str, nn.Module], steps: int = STEPS, seed: int = 0) -> None:
        super().__init__()
        self.prefix, self.step = graphs["prefix"], graphs["step"]
        self.steps = steps
        self.noise = torch.Generator().manual_seed(seed)

    def forward(self, image: Tensor, proprio: Tensor, instruction: Tensor) -> Tensor:
        """Image (B, 96, 96, 3) uint8, proprio (B, 4) normalised, ids (B, 8) -> actions (B, 8, 4) normalised."""
        context = self.prefix(image, proprio, instruction)
        x = torch.randn(len(image), CHUNK, ACTION_DIM, generator=self.noise)
        dt = torch.full((len(image),), -1.0 / self.steps)
        for step in range(self.steps):
            x = self.step(x, 1.0 + step * dt, dt, context)
        return x


def load_runner(folder: Path) -> Runner:
    """Loads the policy whose weights, vocabulary and statistics are in a folder."""
    return Runner.load(Sampler(make(folder / "weights.safetensors")), folder)
