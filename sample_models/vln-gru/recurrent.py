"""The vln-gru policy: one egocentric RGB frame, the last action and an instruction to one discrete action and a memory.

Shapes use B batch, D model width.
"""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

ACTIONS = ("left", "right", "forward")
NO_ACTION = len(ACTIONS)  # the `action_before` of the first step
WORDS = 16  # rows of the word embedding, see vocabulary.json
WIDTH = 96
CHANNELS = 32
WEIGHTS = Path(__file__).with_name("weights.safetensors")


class Policy(nn.Module):
    """What is seen, modulated by the instruction (FiLM), updates a memory (GRU) that chooses the action with it."""

    def __init__(self) -> None:
        super().__init__()
        self.words = nn.Embedding(WORDS, WIDTH)
        self.action = nn.Embedding(len(ACTIONS) + 1, WIDTH)
        self.patches = nn.Conv2d(3, CHANNELS, kernel_size=8, stride=8)
        self.modulation = nn.Linear(WIDTH, 2 * CHANNELS)
        self.mix = nn.Conv2d(CHANNELS, CHANNELS, kernel_size=3, padding=1)
        self.features = nn.Linear(CHANNELS * 49, WIDTH)
        self.memory = nn.GRUCell(WIDTH, WIDTH)
        self.head = nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, len(ACTIONS)))

    def forward(
        self, image: Tensor, action_before: Tensor, instruction: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Score the actions of one step.

        Args:
            image: (B, 56, 56, 3) uint8.
            action_before: (B, 1) int64, NO_ACTION at the first step.
            instruction: (B, 8) int64 word ids.
            memory: (B, D) float32, zero at the first step.

        Returns:
            Logits (B, 3) in the order of ACTIONS, and the memory after this step (B, D).
        """
        sentence = self.words(instruction).mean(1)
        pixels = image.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        scale, shift = self.modulation(sentence)[:, :, None, None].chunk(2, dim=1)
        seen = torch.relu(self.patches(pixels) * (1 + scale) + shift)
        seen = torch.relu(self.mix(seen)).flatten(1)
        features = torch.relu(self.features(seen) + sentence + self.action(action_before[:, 0]))
        memory = self.memory(features, memory)
        return self.head(torch.cat([features, memory], 1)), memory


def make(weights: Path | None = WEIGHTS) -> Policy:
    """Build the policy in evaluation mode; `weights=None` leaves it randomly initialised."""
    policy = Policy()
    if weights is not None:
        policy.load_state_dict(load_file(weights))
    return policy.eval()
