"""A small vision-language-action policy: camera and word tokens, a fusion transformer, one action chunk in one pass."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vlatool.samples._blocks import EncoderBlock, additive
from vlatool.samples._vision import VIT_S, VisionEncoder, VisionShape


@dataclass(frozen=True)
class FusionShape:
    """Shape of the policy; the width is the vision encoder's.

    Args:
        vision: Encoder that all cameras share.
        vocabulary: Number of token ids; id 0 is padding.
    """

    vision: VisionShape = VIT_S
    cameras: int = 2
    words: int = 80
    vocabulary: int = 32000
    depth: int = 6
    chunk: int = 16
    action: int = 7


class FusionPolicy(nn.Module):
    """Cameras and instruction to an action chunk; learned action queries attend to everything."""

    def __init__(self, shape: FusionShape) -> None:
        super().__init__()
        vision, width = shape.vision, shape.vision.width
        self.chunk = shape.chunk
        self.vision = VisionEncoder(vision)
        self.connect = nn.Linear(width, width)
        self.words = nn.Embedding(shape.vocabulary, width)
        self.word_positions = nn.Parameter(torch.empty(shape.words, width))
        self.cameras = nn.Parameter(torch.empty(shape.cameras, width))
        self.queries = nn.Parameter(torch.empty(shape.chunk, width))
        self.blocks = nn.ModuleList(EncoderBlock(width, vision.heads, vision.hidden) for _ in range(shape.depth))
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.head = nn.Linear(width, shape.action)

    def forward(self, front: Tensor, wrist: Tensor, words: Tensor) -> Tensor:
        """Two (1, H, W, 3) uint8 images and (1, words) int64 ids -> (1, chunk, action) float32."""
        seen = self.connect(self.vision(torch.cat([front, wrist]))) + self.cameras[:, None]
        seen = seen.flatten(0, 1)[None]
        read = self.words(words) + self.word_positions
        tokens = torch.cat([seen, read, self.queries[None]], dim=1)
        mask = self._mask(seen, words, tokens.dtype)
        for block in self.blocks:
            tokens = block(tokens, mask)
        result: Tensor = self.head(self.norm(tokens[:, -self.chunk :]))
        return result

    def _mask(self, seen: Tensor, words: Tensor, dtype: torch.dtype) -> Tensor:
        """Hide padding: (1, 1, 1, tokens), additive."""
        always = torch.ones(1, seen.shape[1], dtype=torch.bool, device=words.device)
        visible = torch.cat([always, words != 0, always[:, : self.chunk]], dim=1)
        return additive(visible, dtype)[:, None, None]
