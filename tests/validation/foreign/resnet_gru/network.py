"""Somebody's recurrent policy: a ResNet-18 of transformers and a GRU that carries its state from step to step."""

import torch
from torch import nn
from transformers import ResNetConfig, ResNetModel

RESNET_18 = ResNetConfig(embedding_size=64, hidden_sizes=[64, 128, 256, 512], depths=[2, 2, 2, 2], layer_type="basic")


class Recurrent(nn.Module):
    """Camera (B, 3, 96, 96) in 0..1, joints (B, 7) and state (1, B, 128) to velocities (B, 7) and the next state."""

    def __init__(self):
        super().__init__()
        self.camera = ResNetModel(RESNET_18)
        self.gru = nn.GRU(512 + 7, 128)
        self.head = nn.Linear(128, 7)

    def forward(self, picture, joints, state):
        seen = torch.cat([self.camera(picture).pooler_output.flatten(1), joints], dim=-1)
        out, state = self.gru(seen.unsqueeze(0), state)
        return self.head(out[0]), state
