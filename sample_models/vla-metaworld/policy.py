"""A small language-conditioned robot policy: camera image + proprioception + instruction -> action chunk.

Shapes use B batch, T tokens, D width, C chunk length. The policy is a conv stem that turns the image into a
6 x 6 grid of tokens, a word embedding, a proprioception token and one learned query token per action step; a
pre-norm transformer mixes all of them and a linear head reads the actions off the query tokens.
"""

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
WIDTH = 384
DEPTH = 4
HEADS = 6
STEM_CHANNELS = (48, 64, 128)


class VisionStem(nn.Module):
    """Turns raw pixels into a grid of image tokens with four strided convolutions (1/16 resolution)."""

    def __init__(self, width: int = WIDTH, channels: tuple[int, int, int] = STEM_CHANNELS) -> None:
        super().__init__()
        first, second, third = channels
        self.patchify = nn.Conv2d(3, first, kernel_size=4, stride=4)
        self.local = nn.Conv2d(first, second, kernel_size=3, padding=1)
        self.down1 = nn.Conv2d(second, third, kernel_size=3, stride=2, padding=1)
        self.down2 = nn.Conv2d(third, width, kernel_size=3, stride=2, padding=1)
        self.position = nn.Parameter(torch.randn(1, (IMAGE_SIZE // 16) ** 2, width) * 0.02)

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

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.words = nn.Embedding(VOCABULARY_SIZE, width)
        self.position = nn.Parameter(torch.randn(1, MAX_WORDS, width) * 0.02)

    def forward(self, instruction: Tensor) -> Tensor:
        """Word ids (B, 8) int64 -> tokens (B, 8, D)."""
        return self.words(instruction) + self.position


class Attention(nn.Module):
    """Multi-head self-attention without a mask."""

    def __init__(self, width: int = WIDTH, heads: int = HEADS) -> None:
        super().__init__()
        self.heads = heads
        self.query_key_value = nn.Linear(width, 3 * width)
        self.output = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (B, T, D) -> (B, T, D)."""
        batch, length, width = tokens.shape
        query, key, value = (
            part.reshape(batch, length, self.heads, width // self.heads).transpose(1, 2)
            for part in self.query_key_value(tokens).chunk(3, dim=-1)
        )
        scores = (query * (width // self.heads) ** -0.5) @ key.transpose(-2, -1)
        attended = scores.softmax(dim=-1) @ value
        return self.output(attended.transpose(1, 2).reshape(batch, length, width))


class Block(nn.Module):
    """One pre-norm transformer block: attention, then a four times wider GELU MLP."""

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(width)
        self.attention = Attention(width)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (B, T, D) -> (B, T, D)."""
        tokens = tokens + self.attention(self.attention_norm(tokens))
        return tokens + self.mlp(self.mlp_norm(tokens))


class VlaPolicy(nn.Module):
    """Vision-language-action policy; proprioception comes in and the action goes out normalised."""

    def __init__(self, width: int = WIDTH, depth: int = DEPTH) -> None:
        super().__init__()
        self.vision = VisionStem(width)
        self.language = LanguageEmbedding(width)
        self.proprio = nn.Sequential(nn.Linear(PROPRIO_DIM, width), nn.GELU(), nn.Linear(width, width))
        self.action_queries = nn.Parameter(torch.randn(1, CHUNK, width) * 0.02)
        self.fusion = nn.ModuleList(Block(width) for _ in range(depth))
        self.action_norm = nn.LayerNorm(width)
        self.action_head = nn.Linear(width, ACTION_DIM)

    def forward(self, image: Tensor, proprio: Tensor, instruction: Tensor) -> Tensor:
        """Image (B, 96, 96, 3) uint8, proprio (B, 4) normalised, ids (B, 8) -> actions (B, 8, 4) normalised."""
        queries = self.action_queries.expand(image.shape[0], -1, -1)
        words = self.language(instruction)
        hand = self.proprio(proprio).unsqueeze(1)
        tokens = torch.cat([queries, hand, words, self.vision(image)], dim=1)
        for block in self.fusion:
            tokens = block(tokens)
        return self.action_head(self.action_norm(tokens[:, :CHUNK]))


WEIGHTS = Path(__file__).with_name("weights.safetensors")


def make(weights: Path | None = WEIGHTS) -> nn.Module:
    """Builds the policy in eval mode; loads `weights` (None: random initialisation)."""
    policy = VlaPolicy()
    if weights is not None:
        policy.load_state_dict({name: value.float() for name, value in load_file(weights).items()})
    return policy.eval()
