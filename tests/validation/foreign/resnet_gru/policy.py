from pathlib import Path

import torch
from network import Recurrent
from torch import nn


class Step(nn.Module):
    """One control step: camera (1, 96, 96, 3) uint8, joints (1, 7), memory (1, 1, 128)."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, image, joints, memory):
        picture = image.permute(0, 3, 1, 2).float() / 255
        action, memory = self.network(picture, joints, memory)
        return action.unsqueeze(1), memory  # (1, 1, 7): a chunk of one action


def make():
    network = Recurrent()
    network.load_state_dict(torch.load(Path(__file__).parent / "weights.pt"))
    return Step(network)
