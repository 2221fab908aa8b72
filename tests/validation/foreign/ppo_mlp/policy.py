from pathlib import Path

import torch
from stable_baselines3 import PPO
from torch import nn


class Deterministic(nn.Module):
    """State (1, 3) to torque (1, 1, 1) in Nm: the mean of the distribution, clipped as predict() does."""

    def __init__(self, policy):
        super().__init__()
        self.actor = policy.mlp_extractor.policy_net
        self.action = policy.action_net
        self.register_buffer("low", torch.as_tensor(policy.action_space.low))
        self.register_buffer("high", torch.as_tensor(policy.action_space.high))

    def forward(self, state):
        return torch.clamp(self.action(self.actor(state)), self.low, self.high).unsqueeze(1)


def make():
    return Deterministic(PPO.load(Path(__file__).parent / "ppo.zip", device="cpu").policy)
