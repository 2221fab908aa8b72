"""A small language-conditioned robot policy that draws its actions by flow matching, as pi0 and SmolVLA do.

Shapes use B batch, P prefix tokens, T tokens, D width, C chunk length. Two graphs: `Prefix` turns the camera image, the
instruction and the hand's position into context tokens, once for each chunk; `Step` is one Euler step that moves a
chunk of noisy actions along the velocity it predicts. Time `t` runs from 1 (noise) to 0 (actions); both `t` and the
step `dt` are inputs, so the number of steps is a matter of who calls it.
"""

import math
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

IMAGE_SIZE = 96
PROPRIO_DIM = 4
ACTION_DIM = 4
CHUNK = 8
MAX_WORDS = 8
VOCABULARY_SIZE = 48
STEM_CHANNELS = (48, 64, 128)
TRUNK_WIDTH, TRUNK_HEADS, TRUNK_DEPTH = 384, 6, 2
EXPERT_WIDTH, EXPERT_HEADS, EXPERT_DEPTH = 256, 4, 3
EXPERT_HIDDEN = 768
SHORTEST_PERIOD, LONGEST_PERIOD = 4e-3, 4.0
STEPS = 10


class VisionStem(nn.Module):
    """Turns raw pixels into a grid of image tokens with four strided convolutions (1/16 resolution)."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third = STEM_CHANNELS
        self.patchify = nn.Conv2d(3, first, kernel_size=4, stride=4)
        self.local = nn.Conv2d(first, second, kernel_size=3, padding=1)
        self.down1 = nn.Conv2d(second, third, kernel_size=3, stride=2, padding=1)
        self.down2 = nn.Conv2d(third, TRUNK_WIDTH, kernel_size=3, stride=2, padding=1)
        self.position = nn.Parameter(torch.randn(1, (IMAGE_SIZE // 16) ** 2, TRUNK_WIDTH) * 0.02)

    def forward(self, image: Tensor) -> Tensor:
        """Image (B, 96, 96, 3) uint8 -> tokens (B, 36, D)."""
        pixels = image.permute(0, 3, 1, 2).to(self.position.dtype) / 127.5 - 1.0
        features = functional.gelu(self.patchify(pixels))
        features = functional.gelu(self.local(features))
        features = functional.gelu(self.down1(features))
        features = self.down2(features)
        return features.flatten(2).transpose(1, 2) + self.position


class LanguageEmbedding(nn.Module):
    """Embeds word ids and adds their positions; padding has an embedding of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.words = nn.Embedding(VOCABULARY_SIZE, TRUNK_WIDTH)
        self.position = nn.Parameter(torch.randn(1, MAX_WORDS, TRUNK_WIDTH) * 0.02)

    def forward(self, instruction: Tensor) -> Tensor:
        """Word ids (B, 8) int64 -> tokens (B, 8, D)."""
        return self.words(instruction) + self.position


def attend(query: Tensor, key: Tensor, value: Tensor, heads: int) -> Tensor:
    """Multi-head attention without a mask: query (..., T, D), key and value (..., P, D) -> (..., T, D)."""
    query, key, value = (part.unflatten(-1, (heads, -1)).transpose(-3, -2) for part in (query, key, value))
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1)
    return (scores.softmax(dim=-1) @ value).transpose(-3, -2).flatten(-2)


class SelfAttention(nn.Module):
    """Every token attends to every token."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query_key_value = nn.Linear(width, 3 * width)
        self.output = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (B, T, D) -> (B, T, D)."""
        query, key, value = self.query_key_value(tokens).chunk(3, dim=-1)
        return self.output(attend(query, key, value, self.heads))


class CrossAttention(nn.Module):
    """Action tokens attend to the context, whose keys and values are projected here (as in SmolVLA)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)

    def forward(self, tokens: Tensor, context: Tensor) -> Tensor:
        """Tokens (B, T, D), context (B, P, D) -> (B, T, D)."""
        key, value = self.key_value(context).chunk(2, dim=-1)
        return self.output(attend(self.query(tokens), key, value, self.heads))


def feedforward(width: int, hidden: int) -> nn.Sequential:
    """Linear, GELU, linear."""
    return nn.Sequential(nn.Linear(width, hidden), nn.GELU(), nn.Linear(hidden, width))


class TrunkBlock(nn.Module):
    """One pre-norm transformer block over the prefix tokens."""

    def __init__(self) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(TRUNK_WIDTH)
        self.attention = SelfAttention(TRUNK_WIDTH, TRUNK_HEADS)
        self.mlp_norm = nn.LayerNorm(TRUNK_WIDTH)
        self.mlp = feedforward(TRUNK_WIDTH, 4 * TRUNK_WIDTH)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (B, P, D) -> (B, P, D)."""
        tokens = tokens + self.attention(self.attention_norm(tokens))
        return tokens + self.mlp(self.mlp_norm(tokens))


class Prefix(nn.Module):
    """Image, hand and instruction -> context tokens; runs once for each chunk."""

    def __init__(self) -> None:
        super().__init__()
        self.vision = VisionStem()
        self.language = LanguageEmbedding()
        self.proprio = nn.Sequential(
            nn.Linear(PROPRIO_DIM, TRUNK_WIDTH), nn.GELU(), nn.Linear(TRUNK_WIDTH, TRUNK_WIDTH)
        )
        self.fusion = nn.ModuleList(TrunkBlock() for _ in range(TRUNK_DEPTH))
        self.context_norm = nn.LayerNorm(TRUNK_WIDTH)
        self.to_context = nn.Linear(TRUNK_WIDTH, EXPERT_WIDTH)

    def forward(self, image: Tensor, proprio: Tensor, instruction: Tensor) -> Tensor:
        """Image (B, 96, 96, 3) uint8, proprio (B, 4) normalised, ids (B, 8) -> context (B, 45, D)."""
        hand = self.proprio(proprio).unsqueeze(1)
        tokens = torch.cat([hand, self.language(instruction), self.vision(image)], dim=1)
        for block in self.fusion:
            tokens = block(tokens)
        return self.to_context(self.context_norm(tokens))


def embed_time(t: Tensor) -> Tensor:
    """Time (...) -> sines and cosines (..., D) of geometrically spaced periods."""
    half = EXPERT_WIDTH // 2
    ratio = LONGEST_PERIOD / SHORTEST_PERIOD
    rates = [2 * math.pi / (SHORTEST_PERIOD * ratio ** (index / (half - 1))) for index in range(half)]
    angles = t.float()[..., None] * torch.tensor(rates, dtype=torch.float32)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class TimedActions(nn.Module):
    """Noisy actions and the time -> one token for each action of the chunk."""

    def __init__(self) -> None:
        super().__init__()
        self.action = nn.Linear(ACTION_DIM, EXPERT_WIDTH)
        self.join = nn.Sequential(
            nn.Linear(2 * EXPERT_WIDTH, EXPERT_WIDTH), nn.SiLU(), nn.Linear(EXPERT_WIDTH, EXPERT_WIDTH)
        )
        self.position = nn.Parameter(torch.randn(1, CHUNK, EXPERT_WIDTH) * 0.02)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """Noisy actions (B, C, 4), time (B,) -> tokens (B, C, D)."""
        actions = self.action(x)
        time = embed_time(t).unsqueeze(-2).expand_as(actions)
        return self.join(torch.cat([actions, time], dim=-1)) + self.position


class ExpertBlock(nn.Module):
    """One pre-norm block of the action expert: attention among the actions, to the context, then an MLP."""

    def __init__(self) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(EXPERT_WIDTH)
        self.attention = SelfAttention(EXPERT_WIDTH, EXPERT_HEADS)
        self.cross_norm = nn.LayerNorm(EXPERT_WIDTH)
        self.cross = CrossAttention(EXPERT_WIDTH, EXPERT_HEADS)
        self.mlp_norm = nn.LayerNorm(EXPERT_WIDTH)
        self.mlp = feedforward(EXPERT_WIDTH, EXPERT_HIDDEN)

    def forward(self, tokens: Tensor, context: Tensor) -> Tensor:
        """Tokens (B, C, D), context (B, P, D) -> (B, C, D)."""
        tokens = tokens + self.attention(self.attention_norm(tokens))
        tokens = tokens + self.cross(self.cross_norm(tokens), context)
        return tokens + self.mlp(self.mlp_norm(tokens))


class Step(nn.Module):
    """One Euler step of the flow; runs as often as the schedule says."""

    def __init__(self) -> None:
        super().__init__()
        self.embed = TimedActions()
        self.expert = nn.ModuleList(ExpertBlock() for _ in range(EXPERT_DEPTH))
        self.velocity_norm = nn.LayerNorm(EXPERT_WIDTH)
        self.velocity_head = nn.Linear(EXPERT_WIDTH, ACTION_DIM)

    def velocity(self, x: Tensor, t: Tensor, context: Tensor) -> Tensor:
        """Noisy actions (..., C, 4), time (...), context (..., P, D) -> d x / d t (..., C, 4)."""
        tokens = self.embed(x, t)
        for block in self.expert:
            tokens = block(tokens, context)
        return self.velocity_head(self.velocity_norm(tokens))

    def forward(self, x: Tensor, t: Tensor, dt: Tensor, context: Tensor) -> Tensor:
        """Noisy actions (B, C, 4) at time t (B,) -> actions at time t + dt (B, C, 4)."""
        return x + dt[:, None, None] * self.velocity(x, t, context)


WEIGHTS = Path(__file__).with_name("weights.safetensors")


def make(weights: Path | None = WEIGHTS) -> dict[str, nn.Module]:
    """Builds both graphs in eval mode; loads `weights` (None: random initialisation)."""
    policy = nn.ModuleDict({"prefix": Prefix(), "step": Step()})
    if weights is not None:
        policy.load_state_dict({name: value.float() for name, value in load_file(weights).items()})
    return dict(policy.eval().items())
