"""Decoder-only language layers as in Llama: RMS norm, rotary positions, shared key/value heads, SwiGLU."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from vlatool.samples._blocks import MASK_VALUE, GatedFeedforward, attend, split_heads
from vlatool.samples._build import Constants

Angles = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class DecoderShape:
    """Shape of a decoder."""

    width: int
    layers: int
    heads: int
    shared_heads: int
    head_width: int
    hidden: int
    base: float = 10000.0
    epsilon: float = 1e-5


SMOLLM2_360M = DecoderShape(width=960, layers=32, heads=15, shared_heads=5, head_width=64, hidden=2560, base=100000.0)
SMOLLM2_HALF = replace(SMOLLM2_360M, layers=16)
LLAMA2_7B = DecoderShape(width=4096, layers=32, heads=32, shared_heads=32, head_width=128, hidden=11008)


class Rotary(Constants):
    """Rotary positions (Su et al., arXiv 2104.09864), half-split as in Llama; wave lengths are a series of ``base``."""

    cosines: Tensor
    sines: Tensor

    def __init__(self, length: int, width: int, base: float) -> None:
        super().__init__()
        self.base = base
        self.register_buffer("cosines", torch.empty(length, width), persistent=False)
        self.register_buffer("sines", torch.empty(length, width), persistent=False)

    def reset_constants(self) -> None:
        """Compute the table in float64."""
        length, width = self.cosines.shape
        rates = self.base ** -(torch.arange(0, width, 2, dtype=torch.float64) / width)
        angles = torch.outer(torch.arange(length, dtype=torch.float64), rates).repeat(1, 2)
        self.cosines.copy_(angles.cos())
        self.sines.copy_(angles.sin())

    def forward(self, positions: Tensor) -> Angles:
        """(B, T) int64 -> cosines and sines, each (B, 1, T, width)."""
        cosines, sines = (functional.embedding(positions, table) for table in (self.cosines, self.sines))
        return cosines[:, None], sines[:, None]

    def first(self, length: int) -> Angles:
        """Cosines and sines of positions 0 to ``length`` - 1, each (1, 1, length, width)."""
        return self.cosines[None, None, :length], self.sines[None, None, :length]


def rotate(heads: Tensor, angles: Angles) -> Tensor:
    """(B, H, T, D) -> (B, H, T, D), each pair of channels turned by the angle of its position."""
    cosines, sines = angles
    low, high = heads.chunk(2, dim=-1)
    return heads * cosines + torch.cat([-high, low], dim=-1) * sines


class Causal(Constants):
    """Additive mask that hides later tokens."""

    mask: Tensor

    def __init__(self, length: int) -> None:
        super().__init__()
        self.register_buffer("mask", torch.empty(length, length), persistent=False)

    def reset_constants(self) -> None:
        """Block everything above the diagonal."""
        self.mask.copy_(torch.full(self.mask.shape, MASK_VALUE).triu(1))

    def forward(self) -> Tensor:
        """() -> (length, length)."""
        return self.mask


@dataclass(frozen=True)
class Past:
    """A key/value cache of fixed size.

    Args:
        keys: (B, layers, shared_heads, S, D), or (B, shared_heads, S, D) of one layer.
        here: (S, 1) bool, True where the new key and value go.
    """

    keys: Tensor
    values: Tensor
    here: Tensor

    def layer(self, index: int) -> Past:
        """The cache of one layer."""
        return Past(self.keys[:, index], self.values[:, index], self.here)

    def insert(self, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Put one layer's new key and value, (B, shared_heads, 1, D) each, into their place."""
        return torch.where(self.here, key, self.keys), torch.where(self.here, value, self.values)


class DecoderLayer(nn.Module):
    """One layer; its attention can be fed with keys and values from elsewhere."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.heads, self.shared_heads = shape.heads, shape.shared_heads
        queries, shared = shape.heads * shape.head_width, shape.shared_heads * shape.head_width
        self.norm_attention = nn.RMSNorm(shape.width, eps=shape.epsilon)
        self.query = nn.Linear(shape.width, queries, bias=False)
        self.key = nn.Linear(shape.width, shared, bias=False)
        self.value = nn.Linear(shape.width, shared, bias=False)
        self.out = nn.Linear(queries, shape.width, bias=False)
        self.norm_feedforward = nn.RMSNorm(shape.width, eps=shape.epsilon)
        self.feedforward = GatedFeedforward(shape.width, shape.hidden)

    def project(self, tokens: Tensor, angles: Angles) -> tuple[Tensor, Tensor, Tensor]:
        """(B, T, width) -> query (B, heads, T, D), key and value (B, shared_heads, T, D); query and key are rotated."""
        normed = self.norm_attention(tokens)
        key = rotate(split_heads(self.key(normed), self.shared_heads), angles)
        return self.project_query(normed, angles), key, split_heads(self.value(normed), self.shared_heads)

    def project_query(self, normed: Tensor, angles: Angles) -> Tensor:
        """(B, T, width), normalised -> rotated query (B, heads, T, D)."""
        return rotate(split_heads(self.query(normed), self.heads), angles)

    def finish(self, tokens: Tensor, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None) -> Tensor:
        """Attention, feed-forward and both residuals: (B, T, width) -> (B, T, width)."""
        tokens = tokens + self.out(attend(query, key, value, mask))
        result: Tensor = tokens + self.feedforward(self.norm_feedforward(tokens))
        return result

    def forward(
        self, tokens: Tensor, angles: Angles, mask: Tensor | None, past: Past | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(B, T, width) -> tokens (B, T, width), key and value (B, shared_heads, T, D), or S for T with a past."""
        query, key, value = self.project(tokens, angles)
        if past is not None:
            key, value = past.insert(key, value)
        return self.finish(tokens, query, key, value, mask), key, value


class Decoder(nn.Module):
    """A stack of layers with one position table for ``length`` positions."""

    def __init__(self, shape: DecoderShape, length: int) -> None:
        super().__init__()
        self.rotary = Rotary(length, shape.head_width, shape.base)
        self.layers = nn.ModuleList(DecoderLayer(shape) for _ in range(shape.layers))
        self.norm = nn.RMSNorm(shape.width, eps=shape.epsilon)

    def forward(
        self, tokens: Tensor, angles: Angles, mask: Tensor | None, past: Past | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run all layers.

        Returns:
            Tokens (B, T, width), not yet normalised; keys and values (B, layers, shared_heads, T, D),
            or of the length of the past.
        """
        keys, values = [], []
        for index, layer in enumerate(self.layers):
            tokens, key, value = layer(tokens, angles, mask, past.layer(index) if past else None)
            keys.append(key)
            values.append(value)
        return tokens, torch.stack(keys, dim=1), torch.stack(values, dim=1)


class Prefill(nn.Module):
    """A decoder over given embeddings, causal."""

    def __init__(self, shape: DecoderShape, length: int) -> None:
        super().__init__()
        self.decoder = Decoder(shape, length)
        self.causal = Causal(length)

    def forward(self, embeddings: Tensor) -> Tensor:
        """(B, length, width) -> hidden states (B, length, width)."""
        angles = self.decoder.rotary.first(embeddings.shape[1])
        tokens, _, _ = self.decoder(embeddings, angles, self.causal())
        result: Tensor = self.decoder.norm(tokens)
        return result
