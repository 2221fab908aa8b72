"""Vision transformers over raw camera images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vlatool.samples._blocks import EncoderBlock
from vlatool.samples._build import Constants

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
SYMMETRIC = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
Colours = tuple[tuple[float, float, float], tuple[float, float, float]]


class Pixels(Constants):
    """Raw RGB to normalised planes; ``colours`` are mean and deviation of each channel, on the scale from 0 to 1."""

    scale: Tensor
    shift: Tensor

    def __init__(self, colours: Colours) -> None:
        super().__init__()
        self.colours = colours
        self.register_buffer("scale", torch.empty(3), persistent=False)
        self.register_buffer("shift", torch.empty(3), persistent=False)

    def reset_constants(self) -> None:
        """Fold ``(x / 255 - mean) / deviation`` into one factor and one summand."""
        mean, deviation = torch.tensor(self.colours, dtype=torch.float64)
        self.scale.copy_(1 / (255 * deviation))
        self.shift.copy_(-mean / deviation)

    def forward(self, image: Tensor) -> Tensor:
        """(B, H, W, 3) uint8 -> (B, 3, H, W) in the dtype of the weights."""
        return (image.to(self.scale.dtype) * self.scale + self.shift).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class VisionShape:
    """Shape of a vision transformer.

    Args:
        registers: Learned tokens in front of the patches (class token included).
        gains: Whether blocks have learned gains (DINOv2).
    """

    pixels: int
    patch: int
    width: int
    depth: int
    heads: int
    hidden: int
    registers: int = 1
    approximate: str = "none"
    gains: bool = False
    colours: Colours = IMAGENET

    @property
    def patches(self) -> int:
        """Number of patches of an image."""
        return (self.pixels // self.patch) ** 2


VIT_S = VisionShape(224, 16, 384, 12, 6, 1536)
VIT_B = VisionShape(224, 16, 768, 12, 12, 3072)


class VisionEncoder(nn.Module):
    """Patches, learned positions and blocks; ``final_norm`` normalises the tokens at the end."""

    def __init__(self, shape: VisionShape, final_norm: bool = True) -> None:
        super().__init__()
        self.pixels = Pixels(shape.colours)
        self.patches = nn.Conv2d(3, shape.width, shape.patch, stride=shape.patch)
        self.registers = nn.Parameter(torch.empty(shape.registers, shape.width)) if shape.registers else None
        self.positions = nn.Parameter(torch.empty(shape.registers + shape.patches, shape.width))
        self.blocks = nn.ModuleList(
            EncoderBlock(shape.width, shape.heads, shape.hidden, shape.approximate, shape.gains)
            for _ in range(shape.depth)
        )
        self.norm = nn.LayerNorm(shape.width, eps=1e-6) if final_norm else nn.Identity()

    def forward(self, image: Tensor) -> Tensor:
        """(B, pixels, pixels, 3) uint8 -> (B, registers + patches, width)."""
        tokens: Tensor = self.patches(self.pixels(image)).flatten(2).transpose(1, 2)
        if self.registers is not None:
            tokens = torch.cat([self.registers.expand(image.shape[0], -1, -1), tokens], dim=1)
        tokens = tokens + self.positions
        for block in self.blocks:
            tokens = block(tokens)
        result: Tensor = self.norm(tokens)
        return result


class VisionFeatures(nn.Module):
    """A vision transformer with a linear head on the class token; ``shape`` has at least one register."""

    def __init__(self, shape: VisionShape, features: int = 1000) -> None:
        super().__init__()
        self.encoder = VisionEncoder(shape)
        self.head = nn.Linear(shape.width, features)

    def forward(self, image: Tensor) -> Tensor:
        """(B, pixels, pixels, 3) uint8 -> (B, features)."""
        result: Tensor = self.head(self.encoder(image)[:, 0])
        return result
