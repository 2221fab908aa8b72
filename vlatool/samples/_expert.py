"""A flow-matching action expert: one denoising pass over an action chunk, with cross attention to a context."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from vlatool.samples._blocks import GatedFeedforward, SelfAttention, attend, sinusoid, split_heads


@dataclass(frozen=True)
class ExpertShape:
    """Shape of the expert; ``width`` is that of the action tokens."""

    width: int = 768
    depth: int = 12
    heads: int = 12
    hidden: int = 2304
    context: int = 960
    chunk: int = 50
    action: int = 32


class CrossAttention(nn.Module):
    """Attention from action tokens to context tokens, without biases."""

    def __init__(self, width: int, heads: int, context: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width, bias=False)
        self.key = nn.Linear(context, width, bias=False)
        self.value = nn.Linear(context, width, bias=False)
        self.out = nn.Linear(width, width, bias=False)

    def forward(self, tokens: Tensor, context: Tensor) -> Tensor:
        """(B, T, width), (B, S, context) -> (B, T, width)."""
        query = split_heads(self.query(tokens), self.heads)
        key, value = (split_heads(project(context), self.heads) for project in (self.key, self.value))
        result: Tensor = self.out(attend(query, key, value))
        return result


class ExpertBlock(nn.Module):
    """Pre-norm self-attention, cross attention and SwiGLU, each with a residual."""

    def __init__(self, shape: ExpertShape) -> None:
        super().__init__()
        self.norm_self = nn.RMSNorm(shape.width, eps=1e-6)
        self.self_attention = SelfAttention(shape.width, shape.heads)
        self.norm_cross = nn.RMSNorm(shape.width, eps=1e-6)
        self.cross_attention = CrossAttention(shape.width, shape.heads, shape.context)
        self.norm_feedforward = nn.RMSNorm(shape.width, eps=1e-6)
        self.feedforward = GatedFeedforward(shape.width, shape.hidden)

    def forward(self, tokens: Tensor, context: Tensor) -> Tensor:
        """(B, T, width), (B, S, context) -> (B, T, width)."""
        tokens = tokens + self.self_attention(self.norm_self(tokens))
        tokens = tokens + self.cross_attention(self.norm_cross(tokens), context)
        result: Tensor = tokens + self.feedforward(self.norm_feedforward(tokens))
        return result


class TimedActions(nn.Module):
    """Embed noisy actions together with the time of the flow (as SmolVLA does)."""

    def __init__(self, action: int, width: int) -> None:
        super().__init__()
        self.embed = nn.Linear(action, width)
        self.join = nn.Linear(2 * width, width)
        self.out = nn.Linear(width, width)

    def forward(self, actions: Tensor, time: Tensor) -> Tensor:
        """(B, T, action), (B,) -> (B, T, width)."""
        embedded: Tensor = self.embed(actions)
        timed = sinusoid(time, embedded.shape[-1]).to(embedded.dtype)[:, None].expand_as(embedded)
        result: Tensor = self.out(functional.silu(self.join(torch.cat([embedded, timed], dim=-1))))
        return result


class ActionExpert(nn.Module):
    """One denoising pass: the velocity of the flow at noisy actions; the last norm is modulated by the time (DiT)."""

    def __init__(self, shape: ExpertShape) -> None:
        super().__init__()
        self.embed = TimedActions(shape.action, shape.width)
        self.positions = nn.Parameter(torch.empty(shape.chunk, shape.width))
        self.blocks = nn.ModuleList(ExpertBlock(shape) for _ in range(shape.depth))
        self.modulate = nn.Linear(shape.width, 2 * shape.width)
        self.norm = nn.RMSNorm(shape.width, eps=1e-6)
        self.head = nn.Linear(shape.width, shape.action)

    def forward(self, actions: Tensor, time: Tensor, context: Tensor) -> Tensor:
        """(1, chunk, action), (1,) in [0, 1], (1, S, context), all float32 -> velocity (1, chunk, action)."""
        tokens = self.embed(actions, time) + self.positions
        for block in self.blocks:
            tokens = block(tokens, context)
        timed = functional.silu(sinusoid(time, tokens.shape[-1]).to(tokens.dtype))
        scale, shift = self.modulate(timed)[:, None].chunk(2, dim=-1)
        result: Tensor = self.head(self.norm(tokens) * (1 + scale) + shift)
        return result
