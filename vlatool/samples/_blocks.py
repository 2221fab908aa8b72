"""Transformer parts that several samples share."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

MASK_VALUE = -1e4  # additive mask value that exists in float16 too


def split_heads(tokens: Tensor, heads: int) -> Tensor:
    """(B, T, heads * D) -> (B, heads, T, D)."""
    batch, length, width = tokens.shape
    return tokens.reshape(batch, length, heads, width // heads).transpose(1, 2)


def attend(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None) -> Tensor:
    """Attention with shared key/value heads; merges the heads.

    Args:
        query: (B, H, T, D).
        key: (B, K, S, D); H is a multiple of K.
        value: (B, K, S, D).
        mask: Added to the scores, broadcast to (B, H, T, S).

    Returns:
        (B, T, H * D).
    """
    groups = query.shape[1] // key.shape[1]
    if groups > 1:
        key, value = (_repeat_heads(tensor, groups) for tensor in (key, value))
    mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
    return mixed.transpose(1, 2).flatten(2)


def _repeat_heads(tensor: Tensor, groups: int) -> Tensor:
    batch, heads, length, width = tensor.shape
    return tensor[:, :, None].expand(batch, heads, groups, length, width).flatten(1, 2)


def additive(visible: Tensor, dtype: torch.dtype) -> Tensor:
    """Bool mask (True: may be seen) -> additive mask of ``dtype``."""
    return visible.logical_not().to(dtype) * MASK_VALUE


def sinusoid(time: Tensor, width: int, shortest: float = 4e-3, longest: float = 4.0) -> Tensor:
    """Embed a scalar in sines and cosines of geometrically spaced periods, in float32 (as openpi and SmolVLA do).

    Args:
        time: (B,) float32 in [0, 1].
        width: Even.

    Returns:
        (B, width) float32.
    """
    half = width // 2
    periods = [shortest * (longest / shortest) ** (index / (half - 1)) for index in range(half)]
    rates = torch.tensor([2 * math.pi / period for period in periods], dtype=torch.float32, device=time.device)
    angles = time.float()[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Feedforward(nn.Module):
    """Linear, GELU (``approximate``: ``"none"``, exact, or ``"tanh"``), linear."""

    def __init__(self, width: int, hidden: int, approximate: str = "none") -> None:
        super().__init__()
        self.up = nn.Linear(width, hidden)
        self.down = nn.Linear(hidden, width)
        self.approximate = approximate

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        result: Tensor = self.down(functional.gelu(self.up(tokens), approximate=self.approximate))
        return result


class GatedFeedforward(nn.Module):
    """SwiGLU without biases: ``down(silu(gate(x)) * up(x))``."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.gate = nn.Linear(width, hidden, bias=False)
        self.up = nn.Linear(width, hidden, bias=False)
        self.down = nn.Linear(hidden, width, bias=False)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        result: Tensor = self.down(functional.silu(self.gate(tokens)) * self.up(tokens))
        return result


class SelfAttention(nn.Module):
    """Multi-head self-attention with one projection for query, key and value, and biases."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.project = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, T, width), additive mask broadcast to (B, heads, T, T) -> (B, T, width)."""
        query, key, value = (split_heads(part, self.heads) for part in self.project(tokens).chunk(3, dim=-1))
        result: Tensor = self.out(attend(query, key, value, mask))
        return result


class Gain(nn.Module):
    """A learned factor for each channel (LayerScale)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.empty(width))

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        return tokens * self.gain


class EncoderBlock(nn.Module):
    """Pre-norm self-attention and GELU feed-forward, each with a residual and, as in DINOv2, a gain if ``gains``."""

    def __init__(self, width: int, heads: int, hidden: int, approximate: str = "none", gains: bool = False) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(width, eps=1e-6)
        self.attention = SelfAttention(width, heads)
        self.norm_feedforward = nn.LayerNorm(width, eps=1e-6)
        self.feedforward = Feedforward(width, hidden, approximate)
        self.gain_attention = Gain(width) if gains else nn.Identity()
        self.gain_feedforward = Gain(width) if gains else nn.Identity()

    def forward(self, tokens: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, T, width), additive mask -> (B, T, width)."""
        tokens = tokens + self.gain_attention(self.attention(self.norm_attention(tokens), mask))
        result: Tensor = tokens + self.gain_feedforward(self.feedforward(self.norm_feedforward(tokens)))
        return result
