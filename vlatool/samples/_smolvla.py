"""The vision-language prefix and the denoising step of a SmolVLA-like policy (arXiv 2506.01844)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from vlatool.samples._blocks import additive, split_heads
from vlatool.samples._expert import TimedActions
from vlatool.samples._language import SMOLLM2_HALF, Angles, Causal, Decoder, DecoderLayer, DecoderShape, Rotary
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
