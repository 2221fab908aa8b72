"""ResNet-18 (He et al., arXiv 1512.03385) over raw camera images."""

from __future__ import annotations

from torch import Tensor, nn

from vlatool.samples._vision import IMAGENET, Pixels


def _convolution(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, padding=size // 2, bias=False), nn.BatchNorm2d(outputs)
    )


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a residual."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = _convolution(inputs, outputs, 3, stride)
        self.second = _convolution(outputs, outputs, 3)
        straight = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if straight else _convolution(inputs, outputs, 1, stride)
        self.relu = nn.ReLU()

    def forward(self, planes: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H / stride, W / stride)."""
        result: Tensor = self.relu(self.second(self.relu(self.first(planes))) + self.shortcut(planes))
        return result


class ResNetFeatures(nn.Module):
    """ResNet-18: two basic blocks a stage, and a linear head to 1000 features."""

    def __init__(self) -> None:
        super().__init__()
        self.pixels = Pixels(IMAGENET)
        self.stem = nn.Sequential(_convolution(3, 64, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        blocks, inputs = [], 64
        for width in (64, 128, 256, 512):
            blocks += [BasicBlock(inputs, width, width // inputs), BasicBlock(width, width, 1)]
            inputs = width
        self.blocks = nn.Sequential(*blocks)
        self.pool = nn.AdaptiveAvgPool2d(1)
        self.head = nn.Linear(inputs, 1000)

    def forward(self, image: Tensor) -> Tensor:
        """(B, H, W, 3) uint8 -> (B, features)."""
        planes = self.blocks(self.stem(self.pixels(image)))
        result: Tensor = self.head(self.pool(planes).flatten(1))
        return result
