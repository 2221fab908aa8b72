"""The vln-babyai policy: a short egocentric RGB history and an instruction to one discrete action.

Shapes use B batch, T frames, D model width, N tokens, H attention heads.
"""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

FRAMES = 8
ACTIONS = ("left", "right", "forward")
NO_ACTION = len(ACTIONS)  # padding id of the `actions` input, before the first step of an episode
MAX_TOKENS = 8
WORDS = 16  # rows of the word embedding, see vocabulary.json
WIDTH = 192
DEPTH = 3
HEADS = 6
CHANNELS = 128
WEIGHTS = Path(__file__).with_name("weights.safetensors")


class ModulatedBlock(nn.Module):
    """Residual convolution over (B, C, 7, 7) whose channels the instruction scales and shifts (FiLM)."""

    def __init__(self) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(CHANNELS, CHANNELS, kernel_size=3, padding=1)
        self.norm = nn.BatchNorm2d(CHANNELS)
        self.modulation = nn.Linear(WIDTH, 2 * CHANNELS)

    def forward(self, patches: Tensor, sentence: Tensor) -> Tensor:
        """Patches (B, C, 7, 7) under a sentence (B, D) to patches (B, C, 7, 7)."""
        scale, shift = self.modulation(sentence)[:, :, None, None].chunk(2, dim=1)
        return patches + torch.relu(self.norm(self.convolution(patches)) * (1 + scale) + shift)


class VisionEncoder(nn.Module):
    """Raw RGB history (B, T, 56, 56, 3) uint8 to image tokens (B, 16, D) that know what is looked for."""

    def __init__(self) -> None:
        super().__init__()
        self.patch_embedding = nn.Conv2d(3 * FRAMES, CHANNELS, kernel_size=8, stride=8)
        self.patch_norm = nn.BatchNorm2d(CHANNELS)
        self.blocks = nn.ModuleList(ModulatedBlock() for _ in range(2))
        self.downsample = nn.Conv2d(CHANNELS, WIDTH, kernel_size=3, stride=2, padding=1)
        self.position = nn.Parameter(0.02 * torch.randn(1, 16, WIDTH))

    def embed_patches(self, image: Tensor) -> Tensor:
        """Stack the T frames over channels and embed 8x8 patches: (B, C, 7, 7)."""
        batch, frames, height, width, channels = image.shape
        stacked = image.permute(0, 1, 4, 2, 3).reshape(batch, frames * channels, height, width)
        return self.patch_embedding(stacked.float() / 127.5 - 1.0)

    def forward(self, patches: Tensor, sentence: Tensor) -> Tensor:
        """Mix neighbouring patches under the sentence (B, D) and halve the 7x7 map to 4x4: tokens (B, 16, D)."""
        patches = torch.relu(self.patch_norm(patches))
        for block in self.blocks:
            patches = block(patches, sentence)
        return self.downsample(patches).flatten(2).transpose(1, 2) + self.position


class SequenceEmbedding(nn.Module):
    """Token ids (B, N) int64 to embedded tokens with positions (B, N, D)."""

    def __init__(self, symbols: int, length: int) -> None:
        super().__init__()
        self.table = nn.Embedding(symbols, WIDTH)
        self.position = nn.Parameter(0.02 * torch.randn(1, length, WIDTH))
        nn.init.normal_(self.table.weight, std=0.5)

    def forward(self, ids: Tensor) -> Tensor:
        """Look the ids up and add the position of each."""
        return self.table(ids) + self.position


class Attention(nn.Module):
    """Multi-head self-attention over tokens (B, N, D)."""

    def __init__(self) -> None:
        super().__init__()
        self.query = nn.Linear(WIDTH, WIDTH)
        self.key = nn.Linear(WIDTH, WIDTH)
        self.value = nn.Linear(WIDTH, WIDTH)
        self.output = nn.Linear(WIDTH, WIDTH)

    def _split_heads(self, tokens: Tensor) -> Tensor:
        """(B, N, D) to (B, H, N, D / H)."""
        batch, length, _ = tokens.shape
        return tokens.reshape(batch, length, HEADS, WIDTH // HEADS).transpose(1, 2)

    def forward(self, tokens: Tensor) -> Tensor:
        """Let every token read all tokens: (B, N, D) to (B, N, D)."""
        query, key, value = (self._split_heads(project(tokens)) for project in (self.query, self.key, self.value))
        scores = query @ key.transpose(-2, -1) * (WIDTH // HEADS) ** -0.5
        mixed = torch.softmax(scores, dim=-1) @ value
        return self.output(mixed.transpose(1, 2).reshape(tokens.shape))


class FusionBlock(nn.Module):
    """One pre-norm transformer block over tokens (B, N, D)."""

    def __init__(self) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(WIDTH)
        self.attention = Attention()
        self.mlp_norm = nn.LayerNorm(WIDTH)
        self.mlp = nn.Sequential(nn.Linear(WIDTH, 4 * WIDTH), nn.GELU(), nn.Linear(4 * WIDTH, WIDTH))

    def forward(self, tokens: Tensor) -> Tensor:
        """Attend, then transform each token: (B, N, D) to (B, N, D)."""
        tokens = tokens + self.attention(self.attention_norm(tokens))
        return tokens + self.mlp(self.mlp_norm(tokens))


class Policy(nn.Module):
    """Image history, previous actions and instruction to action logits."""

    def __init__(self) -> None:
        super().__init__()
        self.vision = VisionEncoder()
        self.language = SequenceEmbedding(WORDS, MAX_TOKENS)
        self.action_history = SequenceEmbedding(len(ACTIONS) + 1, FRAMES - 1)
        self.readout = nn.Parameter(0.02 * torch.randn(1, 1, WIDTH))
        self.fusion = nn.Sequential(*(FusionBlock() for _ in range(DEPTH)))
        self.action_norm = nn.LayerNorm(WIDTH)
        self.action_head = nn.Linear(WIDTH, len(ACTIONS))

    def forward(self, image: Tensor, actions: Tensor, instruction: Tensor) -> Tensor:
        """Score the actions.

        Args:
            image: (B, T, 56, 56, 3) uint8, oldest frame first, all zero before the episode began.
            actions: (B, T - 1) int64, the actions between the frames, NO_ACTION before the episode began.
            instruction: (B, 8) int64 word ids.

        Returns:
            Logits (B, 3) float32 in the order of ACTIONS.
        """
        return self.act(self.vision.embed_patches(image), actions, instruction)

    def act(self, patches: Tensor, actions: Tensor, instruction: Tensor) -> Tensor:
        """Score the actions from embedded patches (B, C, 7, 7) and the inputs of `forward`: logits (B, 3)."""
        words = self.language(instruction)
        image_tokens = self.vision(patches, words.mean(dim=1))
        readout = self.readout.expand(len(patches), -1, -1)
        parts = (readout, image_tokens, words, self.action_history(actions))
        fused = self.fusion(torch.cat(parts, dim=1))
        return self.action_head(self.action_norm(fused[:, 0]))


def make(weights: Path | None = WEIGHTS) -> Policy:
    """Build the policy in evaluation mode; `weights=None` leaves it randomly initialised."""
    policy = Policy()
    if weights is not None:
        policy.load_state_dict(load_file(weights))
    return policy.eval()
