"""The vision-language prefix of a SmolVLA-like policy (arXiv 2506.01844)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vlatool.samples._blocks import additive
from vlatool.samples._language import SMOLLM2_HALF, Decoder, DecoderShape
from vlatool.samples._vision import SYMMETRIC, VisionEncoder, VisionShape

SIGLIP_B = VisionShape(512, 16, 768, 12, 12, 3072, registers=0, approximate="tanh", colours=SYMMETRIC)


@dataclass(frozen=True)
class SmolShape:
    """Shape of the policy.

    Args:
        vision: Encoder without registers.
        shuffle: Side of the square of patches that becomes one token.
        expert_width: Width of the action tokens.
        vocabulary: Number of token ids; id 0 is padding.
        steps: Euler steps from noise to actions.
    """

    vision: VisionShape = SIGLIP_B
    shuffle: int = 4
    language: DecoderShape = SMOLLM2_HALF
    expert_width: int = 720
    expert_hidden: int = 2048
    vocabulary: int = 49280
    words: int = 48
    state: int = 32
    chunk: int = 50
    action: int = 32
    steps: int = 10

    @property
    def prefix(self) -> int:
        """Number of prefix tokens: image, words and one for the state."""
        return self.vision.patches // self.shuffle**2 + self.words + 1


class Prefix(nn.Module):
    """Image, instruction and state to the keys and values of each layer.

    As in checkpoints of this family, some weights are never used, and an export drops them: ``output``, the language
    model's head, and all of the last layer but what makes its key and value.
    """

    def __init__(self, shape: SmolShape) -> None:
        super().__init__()
        width = shape.language.width
        self.shuffle, self.scale = shape.shuffle, width**0.5
        self.vision = VisionEncoder(shape.vision)
        self.connect = nn.Linear(shape.vision.width * shape.shuffle**2, width, bias=False)
        self.words = nn.Embedding(shape.vocabulary, width)
        self.state = nn.Linear(shape.state, width)
        self.decoder = Decoder(shape.language, shape.prefix)
        self.output = nn.Linear(width, shape.vocabulary, bias=False)

    def forward(self, image: Tensor, ids: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(1, H, W, 3) uint8, (1, words) int64, (1, state) float32 -> what the step attends to.

        Returns:
            Keys and values (1, layers, shared_heads, prefix, D) and the mask (1, prefix) bool, False at padding.
        """
        seen = self.connect(self._shuffled(self.vision(image))) * self.scale
        read = self.words(ids) * self.scale
        tokens = torch.cat([seen, read, self.state(state)[:, None]], dim=1)
        always = torch.ones(1, seen.shape[1], dtype=torch.bool, device=ids.device)
        visible = torch.cat([always, ids != 0, always[:, :1]], dim=1)
        positions = visible.to(torch.int64).cumsum(1) - 1
        angles = self.decoder.rotary(positions.clamp(min=0))
        _, keys, values = self.decoder(tokens, angles, self._mask(visible, tokens.dtype))
        return keys, values, visible

    def _shuffled(self, patches: Tensor) -> Tensor:
        """(B, side * side, C) -> (B, (side / shuffle) ** 2, C * shuffle ** 2)."""
        batch, count, width = patches.shape
        shuffle, side = self.shuffle, math.isqrt(count) // self.shuffle
        grid = patches.reshape(batch, side, shuffle, side, shuffle, width).transpose(2, 3)
        return grid.reshape(batch, side * side, shuffle * shuffle * width)

    def _mask(self, visible: Tensor, dtype: torch.dtype) -> Tensor:
        """All tokens see image and words; only the state (the last token) sees itself. (1, 1, prefix, prefix)."""
        others = torch.cat([visible[:, :-1], torch.zeros_like(visible[:, :1])], dim=1)
        rows = others[:, None].expand(-1, visible.shape[1] - 1, -1)
        return additive(torch.cat([rows, visible[:, None]], dim=1), dtype)[:, None]
