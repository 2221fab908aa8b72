"""The denoising step of a SmolVLA-like policy: an expert that attends to the keys and values of the prefix."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from vlatool.samples._blocks import additive, split_heads
from vlatool.samples._expert import TimedActions
from vlatool.samples._language import Angles, Causal, DecoderLayer, DecoderShape, Rotary
from vlatool.samples._smolvla import SmolShape


@dataclass(frozen=True)
class Sight:
    """Context of the action tokens: one object for all layers of a step.

    Args:
        own: Angles of positions counted from the first action.
        after: Angles of positions counted from the first token of the prefix.
        prefix: Additive mask over the prefix.
        joint: Additive mask over the prefix and the action tokens.
    """

    own: Angles
    after: Angles
    prefix: Tensor
    joint: Tensor


class JointLayer(nn.Module):
    """Action tokens attend to the prefix and to earlier action tokens."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.layer = DecoderLayer(shape)

    def forward(self, tokens: Tensor, key: Tensor, value: Tensor, sight: Sight) -> Tensor:
        """(1, chunk, width), the prefix's key and value (1, shared_heads, prefix, D) -> (1, chunk, width)."""
        query, own_key, own_value = self.layer.project(tokens, sight.after)
        key, value = torch.cat([key, own_key], dim=2), torch.cat([value, own_value], dim=2)
        return self.layer.finish(tokens, query, key, value, sight.joint)


class CrossLayer(nn.Module):
    """Action tokens attend to the prefix only, whose key and value are projected once more."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        shared = shape.shared_heads * shape.head_width
        self.layer = DecoderLayer(shape)
        self.layer.key = nn.Linear(shared, shared, bias=False)
        self.layer.value = nn.Linear(shared, shared, bias=False)

    def forward(self, tokens: Tensor, key: Tensor, value: Tensor, sight: Sight) -> Tensor:
        """(1, chunk, width), the prefix's key and value (1, shared_heads, prefix, D) -> (1, chunk, width)."""
        query = self.layer.project_query(self.layer.norm_attention(tokens), sight.own)
        heads = self.layer.shared_heads
        key = split_heads(self.layer.key(key.transpose(1, 2).flatten(2)), heads)
        value = split_heads(self.layer.value(value.transpose(1, 2).flatten(2)), heads)
        return self.layer.finish(tokens, query, key, value, sight.prefix)


class Step(nn.Module):
    """One Euler step of the flow from noise (time 1) to actions (time 0); joint and cross layers alternate."""

    def __init__(self, shape: SmolShape) -> None:
        super().__init__()
        expert = replace(shape.language, width=shape.expert_width, hidden=shape.expert_hidden)
        self.steps = shape.steps
        self.embed = TimedActions(shape.action, shape.expert_width)
        self.rotary = Rotary(shape.prefix + shape.chunk, expert.head_width, expert.base)
        self.causal = Causal(shape.chunk)
        self.layers = nn.ModuleList(
            CrossLayer(expert) if index % 2 else JointLayer(expert) for index in range(expert.layers)
        )
        self.norm = nn.RMSNorm(expert.width, eps=expert.epsilon)
        self.head = nn.Linear(expert.width, shape.action)

    def forward(self, x: Tensor, time: Tensor, keys: Tensor, values: Tensor, mask: Tensor) -> Tensor:
        """One step.

        Args:
            x: (1, chunk, action) float32, noisy actions.
            time: (1,) float32, from 1 down to 1 / steps.
            keys: (1, layers, shared_heads, prefix, D) float32, rotated.
            mask: (1, prefix) bool, False at padding.

        Returns:
            (1, chunk, action) float32, less noisy actions.
        """
        tokens = self.embed(x, time)
        sight = self._sight(mask, tokens)
        for index, layer in enumerate(self.layers):
            tokens = layer(tokens, keys[:, index], values[:, index], sight)
        velocity: Tensor = self.head(self.norm(tokens))
        return x - velocity / self.steps

    def _sight(self, mask: Tensor, tokens: Tensor) -> Sight:
        chunk = tokens.shape[1]
        own = torch.arange(chunk, device=mask.device)[None]
        prefix = additive(mask, tokens.dtype)[:, None, None]
        joint = torch.cat([prefix.expand(-1, -1, chunk, -1), self.causal()[None, None]], dim=3)
        after = own + mask.to(torch.int64).sum(1, keepdim=True)
        return Sight(self.rotary.first(chunk), self.rotary(after), prefix, joint)
