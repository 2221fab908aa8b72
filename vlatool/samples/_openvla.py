"""The two graphs of an OpenVLA-like policy (arXiv 2406.09246): prefill and one greedy decoding step.

Both graphs hold the same language model. Action bins are the last 256 token ids; decoding is restricted to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from vlatool.samples._blocks import additive
from vlatool.samples._language import LLAMA2_7B, Causal, Decoder, DecoderShape, Past
from vlatool.samples._vision import SYMMETRIC, VisionEncoder, VisionShape

DINO_L = VisionShape(224, 14, 1024, 23, 16, 4096, registers=5, gains=True)
SIGLIP_SO = VisionShape(224, 14, 1152, 26, 16, 4304, registers=0, approximate="tanh", colours=SYMMETRIC)


@dataclass(frozen=True)
class OpenShape:
    """Shape of the policy.

    Args:
        first: DINOv2-L with a class token and four registers; without its last block, which OpenVLA does not use.
        second: SigLIP-SO400M, without its last block too.
        vocabulary: Number of token ids that mean something; id 0 is padding.
        rows: Rows of the embedding and the head (padded vocabulary).
        action: Elements of the action, each one token.
    """

    first: VisionShape = DINO_L
    second: VisionShape = SIGLIP_SO
    language: DecoderShape = LLAMA2_7B
    vocabulary: int = 32000
    rows: int = 32064
    bins: int = 256
    words: int = 32
    action: int = 7

    @property
    def prompt(self) -> int:
        """Number of prompt tokens: image and words."""
        return self.first.patches + self.words

    @property
    def slots(self) -> int:
        """Length of the key/value cache: prompt and all action tokens but the last, which nothing attends to."""
        return self.prompt + self.action - 1


class Eyes(nn.Module):
    """Two vision encoders, side by side, and a projector to the language model's width."""

    def __init__(self, shape: OpenShape) -> None:
        super().__init__()
        width, joined = shape.language.width, shape.first.width + shape.second.width
        self.registers = shape.first.registers
        self.first = VisionEncoder(shape.first, final_norm=False)
        self.second = VisionEncoder(shape.second, final_norm=False)
        self.project = nn.Sequential(
            nn.Linear(joined, 4 * joined), nn.GELU(), nn.Linear(4 * joined, width), nn.GELU(), nn.Linear(width, width)
        )

    def forward(self, image: Tensor) -> Tensor:
        """(1, H, W, 3) uint8 -> (1, patches, width)."""
        joined = torch.cat([self.first(image)[:, self.registers :], self.second(image)], dim=-1)
        result: Tensor = self.project(joined)
        return result


class Language(nn.Module):
    """Word embedding, decoder and head over the vocabulary."""

    def __init__(self, shape: OpenShape) -> None:
        super().__init__()
        self.lowest, self.highest = shape.vocabulary - shape.bins, shape.vocabulary
        self.words = nn.Embedding(shape.rows, shape.language.width)
        self.decoder = Decoder(shape.language, shape.slots)
        self.head = nn.Linear(shape.language.width, shape.rows, bias=False)

    def choose(self, hidden: Tensor) -> Tensor:
        """(1, 1, width) -> the likeliest action token (1, 1) int64."""
        logits: Tensor = self.head(self.decoder.norm(hidden))
        return logits[..., self.lowest : self.highest].argmax(-1) + self.lowest


class OpenPrefill(nn.Module):
    """Image and instruction to the key/value cache and the first action token."""

    def __init__(self, shape: OpenShape) -> None:
        super().__init__()
        self.shape = shape
        self.eyes = Eyes(shape)
        self.language = Language(shape)
        self.causal = Causal(shape.prompt)

    def forward(self, image: Tensor, ids: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(1, H, W, 3) uint8, (1, words) int64 -> what decoding starts from.

        Returns:
            Tokens (1, action) int64, the first chosen, the others 0; keys and values (1, layers, heads, slots, D)
            in the dtype of the weights; mask (1, prompt) bool, False at padding.
        """
        seen = self.eyes(image)
        tokens = torch.cat([seen, self.language.words(ids)], dim=1)
        decoder = self.language.decoder
        hidden, keys, values = decoder(tokens, decoder.rotary.first(tokens.shape[1]), self.causal())
        always = torch.ones(1, seen.shape[1], dtype=torch.bool, device=ids.device)
        mask = torch.cat([always, ids != 0], dim=1)
        last = mask.to(torch.int64).sum(1) - 1
        first = self.language.choose(hidden.index_select(1, last))
        room = (0, 0, 0, self.shape.slots - self.shape.prompt)
        chosen = functional.pad(first, (0, self.shape.action - 1))
        return chosen, functional.pad(keys, room), functional.pad(values, room), mask


class OpenDecode(nn.Module):
    """One more action token; ``language`` is shared with the prefill."""

    def __init__(self, shape: OpenShape, language: Language) -> None:
        super().__init__()
        self.shape = shape
        self.language = language

    def forward(
        self, tokens: Tensor, position: Tensor, keys: Tensor, values: Tensor, mask: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Feed the token at ``position`` and choose the next.

        Args:
            tokens: (1, action) int64, chosen up to ``position``.
            position: (1,) int64, from 0 to action - 2.
            keys: (1, layers, heads, slots, D) in the dtype of the weights.
            mask: (1, prompt) bool.

        Returns:
            Action (1, 1, action) float32 in [-1, 1] (bin centres), tokens, keys and values with one more entry.
        """
        decoder = self.language.decoder
        hidden = self.language.words(tokens.index_select(1, position))
        angles = decoder.rotary((mask.to(torch.int64).sum(1) + position)[:, None])
        slots = torch.arange(self.shape.slots - self.shape.prompt, device=mask.device)
        here = (torch.arange(self.shape.slots, device=mask.device) == position + self.shape.prompt)[:, None]
        sight = additive(torch.cat([mask, (slots <= position)[None]], dim=1), hidden.dtype)[:, None, None]
        hidden, keys, values = decoder(hidden, angles, sight, Past(keys, values, here))
        order = torch.arange(self.shape.action, device=mask.device)
        tokens = torch.where(order == position + 1, self.language.choose(hidden), tokens)
        return self._centres(tokens), tokens, keys, values

    def _centres(self, tokens: Tensor) -> Tensor:
        """Token ids -> centres of the ``bins - 1`` intervals between ``bins`` points on [-1, 1] (OpenVLA's rule)."""
        intervals = self.shape.bins - 1
        indices = (self.shape.vocabulary - 1 - tokens).clamp(0, intervals - 1)
        return ((2 * indices.to(torch.float32) + 1) / intervals - 1)[:, None]
