from pathlib import Path

from stable_baselines3 import PPO
from torch import nn


class Logits(nn.Module):
    """Picture (1, 84, 84, 3) uint8 to logits (1, 1, 4) of the moves; the largest is what predict() takes."""

    def __init__(self, policy):
        super().__init__()
        self.eyes = policy.features_extractor
        self.actor = policy.mlp_extractor.policy_net
        self.action = policy.action_net

    def forward(self, image):
        channels_first = image.permute(0, 3, 1, 2).float() / 255  # what VecTransposeImage and preprocess_obs do
        return self.action(self.actor(self.eyes(channels_first))).unsqueeze(1)


def make():
    return Logits(PPO.load(Path(__file__).parent / "ppo.zip", device="cpu").policy)
