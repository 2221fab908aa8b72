"""The network of an OpenVLA checkpoint (Kim et al. 2024, arXiv 2406.09246) in three graphs, without its own code.

Towers are vision transformers as timm has them, the language model is Llama as transformers has it; parameters have the
names of the checkpoint. A picture becomes patches, which stand behind the first token of the prompt; then action tokens
are chosen one after the other, each the most probable one, with a KV cache of fixed length.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

MASK_VALUE = -1e4
"""Added to a score that is not looked at; it exists in float16, too."""


@dataclass(frozen=True)
class TowerShape:
    """Shape of a vision transformer.

    Args:
        width: of its tokens.
        layers: blocks that run: all but the last, whose output nobody takes.
        hidden: width inside of a block's feed-forward part.
        patch: side of a patch in pixels; ``grid``: patches on a side of the picture.
        has_class: whether a token of the class stands in front of the patches; ``registers``: how many more do.
        positions: rows of the position table: of the patches, or of the token of the class, too.
        layer_scale: name of the factor of each branch: ``gamma`` (timm), ``scale_factor`` (OpenVLA); empty for none.
        pre_norm: whether the tokens are normalised before the first block, and patches have no bias, as CLIP has it.
        mean, std: what the pictures are normalised with, of values 0 to 1.
    """

    width: int
    layers: int
    heads: int
    hidden: int
    patch: int
    grid: int
    has_class: bool
    registers: int
    positions: int
    layer_scale: str
    pre_norm: bool
    activation: str
    epsilon: float
    mean: tuple[float, ...]
    std: tuple[float, ...]


@dataclass(frozen=True)
class LanguageShape:
    """Shape of a Llama decoder.

    Args:
        shared_heads: heads of keys and values.
        base: of the rotary positions (``rope_theta``).
        tied: whether the head is the table of embeddings.
    """

    width: int
    layers: int
    heads: int
    shared_heads: int
    head_width: int
    hidden: int
    vocabulary: int
    base: float
    epsilon: float
    tied: bool = False


@dataclass(frozen=True)
class Decoding:
    """How tokens become an action, greedily.

    Args:
        actions: elements of the action, one token each.
        prompt_tokens: ids of a prompt, padding included.
        pad: id that pads it, at its end.
        bins: edges of equal bins over [-1, 1]; an action is the middle of one.
        end: id that follows the last action token: the action token ``end - 1`` is the first bin.
    """

    actions: int
    prompt_tokens: int
    pad: int
    bins: int
    end: int


class LayerScale(nn.Module):
    """A factor for each channel of a branch, under the name that a checkpoint has for it."""

    def __init__(self, width: int, name: str) -> None:
        super().__init__()
        self.name = name
        self.register_parameter(name, nn.Parameter(torch.ones(width)))

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        factor: Tensor = getattr(self, self.name)
        return tokens * factor


class VisionAttention(nn.Module):
    """Self-attention of patches, with queries, keys and values from one product."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        query, key, value = (_split_heads(part, self.heads) for part in self.qkv(tokens).chunk(3, dim=-1))
        result: Tensor = self.proj(_merge_heads(functional.scaled_dot_product_attention(query, key, value)))
        return result


class VisionFeedforward(nn.Module):
    """Linear, GELU, linear."""

    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(shape.width, shape.hidden), nn.Linear(shape.hidden, shape.width)
        self.activation = ACTIVATIONS[shape.activation]

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        result: Tensor = self.fc2(self.activation(self.fc1(tokens)))
        return result


class VisionBlock(nn.Module):
    """One block of a vision transformer."""

    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(shape.width, eps=shape.epsilon) for _ in range(2))
        self.attn, self.mlp = VisionAttention(shape.width, shape.heads), VisionFeedforward(shape)
        named = shape.layer_scale
        self.ls1, self.ls2 = (LayerScale(shape.width, named) if named else nn.Identity() for _ in range(2))

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        result: Tensor = tokens + self.ls2(self.mlp(self.norm2(tokens)))
        return result


class Patches(nn.Module):
    """Pictures (B, 3, H, W) to patches (B, T, width)."""

    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, shape.width, shape.patch, stride=shape.patch, bias=not shape.pre_norm)

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, H, W) float -> (B, T, width)."""
        result: Tensor = self.proj(pictures).flatten(2).transpose(1, 2)
        return result


class Tower(nn.Module):
    """A vision transformer up to its last block but one, not normalised: what ``get_intermediate_layers`` gives."""

    mean: Tensor
    std: Tensor

    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.patch_embed = Patches(shape)
        self.pos_embed = nn.Parameter(torch.zeros(1, shape.positions, shape.width))
        self.has_class, self.registers = shape.has_class, shape.registers
        if shape.has_class:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, shape.width))
        if shape.registers:
            self.reg_token = nn.Parameter(torch.zeros(1, shape.registers, shape.width))
        self.norm_pre = nn.LayerNorm(shape.width, eps=shape.epsilon) if shape.pre_norm else nn.Identity()
        self.blocks = nn.ModuleList(VisionBlock(shape) for _ in range(shape.layers))
        self.class_has_position = shape.positions > shape.grid**2
        for name in ("mean", "std"):
            self.register_buffer(name, torch.tensor(getattr(shape, name)).reshape(1, 3, 1, 1), persistent=False)

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, H, W), 0 to 1 -> (B, patches, width)."""
        tokens = self.patch_embed((pictures - self.mean) / self.std)
        first = [self.cls_token] if self.has_class else []
        more = [self.reg_token] if self.registers else []
        if self.class_has_position:
            tokens = torch.cat([*first, tokens], dim=1) + self.pos_embed
            tokens = torch.cat([tokens[:, :1], *more, tokens[:, 1:]], dim=1) if more else tokens
        else:
            tokens = torch.cat([*first, *more, tokens + self.pos_embed], dim=1)
        tokens = self.norm_pre(tokens)
        for block in self.blocks:
            tokens = block(tokens)
        result: Tensor = tokens[:, len(first) + self.registers :]
        return result


class VisionBackbone(nn.Module):
    """One tower, or two whose features stand beside each other."""

    def __init__(self, towers: Mapping[str, TowerShape]) -> None:
        super().__init__()
        self.names = tuple(towers)
        for name, shape in towers.items():
            self.add_module(name, Tower(shape))

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, H, W), 0 to 1 -> (B, patches, sum of the widths)."""
        return torch.cat([getattr(self, name)(pictures) for name in self.names], dim=-1)


class Projector(nn.Module):
    """Features of patches to tokens of the language model: two or three linear layers with GELU between them.

    Args:
        widths: of what goes in, and of what each layer gives.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.count = len(widths) - 1
        for number, (before, after) in enumerate(itertools.pairwise(widths), 1):
            self.add_module(f"fc{number}", nn.Linear(before, after))

    def forward(self, features: Tensor) -> Tensor:
        """(B, T, width before) -> (B, T, width of the language model)."""
        tokens = features
        for number in range(1, self.count + 1):
            tokens = getattr(self, f"fc{number}")(functional.gelu(tokens) if number > 1 else tokens)
        return tokens


class Attention(nn.Module):
    """Self-attention of Llama over a cache of fixed length."""

    def __init__(self, shape: LanguageShape) -> None:
        super().__init__()
        self.heads, self.shared_heads = shape.heads, shape.shared_heads
        queries, shared = shape.heads * shape.head_width, shape.shared_heads * shape.head_width
        self.q_proj = nn.Linear(shape.width, queries, bias=False)
        self.k_proj = nn.Linear(shape.width, shared, bias=False)
        self.v_proj = nn.Linear(shape.width, shared, bias=False)
        self.o_proj = nn.Linear(queries, shape.width, bias=False)

    def forward(self, tokens: Tensor, angles: tuple[Tensor, Tensor], past: Past) -> tuple[Tensor, Tensor, Tensor]:
        """(B, T, width) -> the same, and keys and values with those of the tokens, (B, shared_heads, S, D)."""
        query = _rotate(_split_heads(self.q_proj(tokens), self.heads), angles)
        key = _rotate(_split_heads(self.k_proj(tokens), self.shared_heads), angles)
        keys, values = past.insert(key, _split_heads(self.v_proj(tokens), self.shared_heads))
        all_keys, all_values = (_repeat_heads(each, self.heads // self.shared_heads) for each in (keys, values))
        mixed = functional.scaled_dot_product_attention(query, all_keys, all_values, attn_mask=past.mask)
        return self.o_proj(_merge_heads(mixed)), keys, values


class Feedforward(nn.Module):
    """The gated feed-forward part of Llama."""

    def __init__(self, shape: LanguageShape) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(shape.width, shape.hidden, bias=False)
        self.up_proj = nn.Linear(shape.width, shape.hidden, bias=False)
        self.down_proj = nn.Linear(shape.hidden, shape.width, bias=False)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        result: Tensor = self.down_proj(functional.silu(self.gate_proj(tokens)) * self.up_proj(tokens))
        return result


@dataclass(frozen=True)
class Past:
    """What a layer's attention looks at.

    Args:
        keys: (B, shared_heads, S, D) of earlier tokens, like ``values``; None where all tokens are here.
        here: (S, 1) bool, True where the new token goes.
        mask: added to the scores, (T, S).
    """

    mask: Tensor
    keys: Tensor | None = None
    values: Tensor | None = None
    here: Tensor | None = None

    def insert(self, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Put the key and value of the new tokens into their place."""
        if self.keys is None or self.values is None or self.here is None:
            return key, value
        return torch.where(self.here, key, self.keys), torch.where(self.here, value, self.values)


class DecoderLayer(nn.Module):
    """One layer of Llama."""

    def __init__(self, shape: LanguageShape) -> None:
        super().__init__()
        self.self_attn, self.mlp = Attention(shape), Feedforward(shape)
        self.input_layernorm = nn.RMSNorm(shape.width, eps=shape.epsilon)
        self.post_attention_layernorm = nn.RMSNorm(shape.width, eps=shape.epsilon)

    def forward(self, tokens: Tensor, angles: tuple[Tensor, Tensor], past: Past) -> tuple[Tensor, Tensor, Tensor]:
        """As ``Attention.forward``."""
        mixed, keys, values = self.self_attn(self.input_layernorm(tokens), angles, past)
        tokens = tokens + mixed
        return tokens + self.mlp(self.post_attention_layernorm(tokens)), keys, values


class Decoder(nn.Module):
    """Embeddings, layers and the last norm."""

    def __init__(self, shape: LanguageShape) -> None:
        super().__init__()
        self.embed_tokens = nn.Embedding(shape.vocabulary, shape.width)
        self.layers = nn.ModuleList(DecoderLayer(shape) for _ in range(shape.layers))
        self.norm = nn.RMSNorm(shape.width, eps=shape.epsilon)


class LanguageModel(nn.Module):
    """Llama over given embeddings and a cache of fixed length.

    Args:
        slots: positions that there are at most.
    """

    cosines: Tensor
    sines: Tensor
    positions: Tensor

    def __init__(self, shape: LanguageShape, slots: int) -> None:
        super().__init__()
        self.model = Decoder(shape)
        self.lm_head = nn.Linear(shape.width, shape.vocabulary, bias=False)
        if shape.tied:
            self.lm_head.weight = self.model.embed_tokens.weight
        rates = shape.base ** -(np.arange(0, shape.head_width, 2) / shape.head_width)
        angles = torch.from_numpy(np.tile(np.outer(np.arange(slots), rates), 2))
        self.register_buffer("cosines", angles.cos().float(), persistent=False)
        self.register_buffer("sines", angles.sin().float(), persistent=False)
        self.register_buffer("positions", torch.arange(slots), persistent=False)

    def read(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens (1, T, width) from the first position on -> the same after all layers, keys and values.

        Returns:
            Hidden states (1, T, width); keys and values (layers, 1, shared_heads, T, D).
        """
        length = tokens.shape[1]
        places = self.positions[:length]
        mask = (places[None] > places[:, None]).to(tokens.dtype) * MASK_VALUE
        past = [Past(mask) for _ in self.model.layers]
        return self._run(tokens, (self.cosines[:length], self.sines[:length]), past)

    def follow(self, token: Tensor, position: Tensor, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One more token id (1, 1) at a position (1,), over a cache, -> as ``read``."""
        angles = self.cosines.index_select(0, position), self.sines.index_select(0, position)
        here = (self.positions == position)[:, None]
        mask = (self.positions > position).to(keys.dtype)[None] * MASK_VALUE
        past = [Past(mask, key, value, here) for key, value in zip(keys.unbind(0), values.unbind(0), strict=True)]
        return self._run(self.model.embed_tokens(token), angles, past)

    def _run(self, tokens: Tensor, angles: tuple[Tensor, Tensor], past: list[Past]) -> tuple[Tensor, Tensor, Tensor]:
        keys, values = [], []
        for layer, before in zip(self.model.layers, past, strict=True):
            tokens, key, value = layer(tokens, angles, before)
            keys.append(key)
            values.append(value)
        return tokens, torch.stack(keys), torch.stack(values)

    def choose(self, state: Tensor) -> Tensor:
        """Hidden state (1, 1, width) -> the most probable next id (1, 1)."""
        logits: Tensor = self.lm_head(self.model.norm(state))
        return logits.argmax(-1)


class Vision(nn.Module):
    """A picture to tokens of the language model."""

    def __init__(self, backbone: VisionBackbone, projector: Projector) -> None:
        super().__init__()
        self.vision_backbone, self.projector = backbone, projector

    def forward(self, image: Tensor) -> Tensor:
        """(1, 3, H, W) uint8 -> (1, patches, width)."""
        tokens: Tensor = self.projector(self.vision_backbone(image.float() / 255))
        return tokens


class Generation(nn.Module):
    """What both graphs of the language model have: it, and how a token becomes an element of the action."""

    centres: Tensor
    numbers: Tensor

    def __init__(self, language: LanguageModel, decoding: Decoding) -> None:
        super().__init__()
        self.language_model, self.decoding = language, decoding
        edges = np.linspace(-1, 1, decoding.bins)
        self.register_buffer("centres", torch.from_numpy((edges[:-1] + edges[1:]) / 2).float(), persistent=False)
        self.register_buffer("numbers", torch.arange(decoding.actions), persistent=False)

    def action(self, tokens: Tensor) -> Tensor:
        """Ids (1, A) -> the middles of their bins (1, A); another id is the nearest bin."""
        bins = (self.decoding.end - tokens - 1).clamp(0, self.centres.shape[0] - 1)
        return functional.embedding(bins, self.centres[:, None])[..., 0]


class Prefill(Generation):
    """Patches and prompt to the cache and the first token."""

    places: Tensor

    def __init__(self, language: LanguageModel, decoding: Decoding) -> None:
        super().__init__(language, decoding)
        self.register_buffer("places", torch.arange(decoding.prompt_tokens), persistent=False)

    def forward(self, patches: Tensor, ids: Tensor) -> tuple[Tensor, ...]:
        """Patches (1, T, width) and ids (1, prompt_tokens) -> the cache, ``start`` (1,), tokens (1, A), action (1, A).

        The cache is keys and values, (layers, 1, shared_heads, S, D) each; ``start`` is the position of the first
        action token. The padding stands behind the prompt, so that no token
        looks at it, and the action tokens take its slots.
        """
        embedded = self.language_model.model.embed_tokens(ids)
        states, keys, values = self.language_model.read(torch.cat([embedded[:, :1], patches, embedded[:, 1:]], dim=1))
        last = torch.where(ids[0] == self.decoding.pad, 0, self.places).amax(0, keepdim=True) + patches.shape[1]
        token = self.language_model.choose(states.index_select(1, last))
        tokens = torch.where(self.numbers[None] == 0, token, 0)
        more = (0, 0, 0, self.decoding.actions - 1)
        return functional.pad(keys, more), functional.pad(values, more), last + 1, tokens, self.action(tokens)


class Decode(Generation):
    """One more action token."""

    def forward(
        self, number: Tensor, keys: Tensor, values: Tensor, start: Tensor, tokens: Tensor
    ) -> tuple[Tensor, ...]:
        """Number (1,) of the token to choose, the cache, start (1,), tokens (1, A) -> the next keys, values and tokens.

        The last output is the action (1, A) so far.
        """
        before = tokens.index_select(1, number - 1)
        state, keys, values = self.language_model.follow(before, start + number - 1, keys, values)
        tokens = torch.where(self.numbers[None] == number, self.language_model.choose(state), tokens)
        return keys, values, tokens, self.action(tokens)


def make(
    towers: Mapping[str, Any], projector: list[int], language: Mapping[str, Any], decoding: Mapping[str, Any]
) -> dict[str, nn.Module]:
    """Return the graphs of an OpenVLA policy; the weights are in the shards of its checkpoint.

    Args:
        towers: name -> fields of ``TowerShape``.
        projector: widths, see ``Projector``.
        language, decoding: fields of ``LanguageShape`` and ``Decoding``.
    """
    shapes = {name: TowerShape(**fields) for name, fields in towers.items()}
    how = Decoding(**decoding)
    slots = next(iter(shapes.values())).grid ** 2 + how.prompt_tokens + how.actions - 1
    llama = LanguageModel(LanguageShape(**language), slots)
    vision = Vision(VisionBackbone(shapes), Projector(tuple(projector)))
    graphs: dict[str, nn.Module] = {"vision": vision, "prefill": Prefill(llama, how)}
    return {**graphs, "decode": Decode(llama, how)} if how.actions > 1 else graphs


def _quick_gelu(values: Tensor) -> Tensor:
    """GELU as OpenAI's CLIP approximates it."""
    return values * torch.sigmoid(1.702 * values)


ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"gelu": functional.gelu, "quick_gelu": _quick_gelu}


def _split_heads(tokens: Tensor, heads: int) -> Tensor:
    """(B, T, heads * D) -> (B, heads, T, D)."""
    batch, length, width = tokens.shape
    return tokens.reshape(batch, length, heads, width // heads).transpose(1, 2)


def _merge_heads(heads: Tensor) -> Tensor:
    """(B, H, T, D) -> (B, T, H * D)."""
    return heads.transpose(1, 2).flatten(2)


def _repeat_heads(heads: Tensor, times: int) -> Tensor:
    return heads if times == 1 else heads.repeat_interleave(times, dim=1)


def _rotate(heads: Tensor, angles: tuple[Tensor, Tensor]) -> Tensor:
    """Rotary positions (Su et al., arXiv 2104.09864) in the halves of Llama: (B, H, T, D) -> the same."""
    cosines, sines = angles
    low, high = heads.chunk(2, dim=-1)
    return heads * cosines + torch.cat([-high, low], dim=-1) * sines
