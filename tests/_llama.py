"""A Llama-shaped policy whose random weights are written to safetensors shards, never all in memory.

This file is the policy's own ``policy.py``, too.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vlatool.errors import require
from vlatool.samples._build import Constants
from vlatool.samples._language import LLAMA2_7B, Causal, Decoder, DecoderShape

VOCABULARY = 32000
LENGTH = 32
CHUNK, JOINTS = 8, 7
SHARD_BYTES = 4 << 30
PART = 1 << 24
"""Weights that are drawn at once."""


class LlamaPolicy(nn.Module):
    """Token ids to a chunk of actions: embedding, decoder, and a head whose first values are the actions.

    Args:
        shape: Of the decoder.
        vocabulary: Size of embedding and head.
        length: Number of tokens.
    """

    def __init__(self, shape: DecoderShape, vocabulary: int, length: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(vocabulary, shape.width)
        self.decoder = Decoder(shape, length)
        self.causal = Causal(length)
        self.head = nn.Linear(shape.width, vocabulary, bias=False)

    def forward(self, ids: Tensor) -> Tensor:
        """(1, length) int64 -> (1, CHUNK, JOINTS) float32."""
        angles = self.decoder.rotary.first(ids.shape[1])
        tokens, mask = self.embedding(ids), self.causal()
        for layer in self.decoder.layers:
            tokens, _, _ = layer(tokens, angles, mask)
        logits: Tensor = self.head(self.decoder.norm(tokens[:, -1:]))
        return logits[:, 0, : CHUNK * JOINTS].reshape(1, CHUNK, JOINTS)


def make(shape: dict[str, Any], vocabulary: int = VOCABULARY, length: int = LENGTH) -> LlamaPolicy:
    """Build the module; its weights are in the shards that policy.yaml names."""
    policy = LlamaPolicy(DecoderShape(**shape), vocabulary, length)
    for part in policy.modules():
        if isinstance(part, Constants):
            part.reset_constants()
    return policy


def write_llama(
    out: Path,
    *,
    shape: DecoderShape = LLAMA2_7B,
    layers: int | None = None,
    vocabulary: int = VOCABULARY,
    length: int = LENGTH,
    seed: int = 0,
    dtype: str = "bfloat16",
    shard_bytes: int = SHARD_BYTES,
    holes: tuple[int, ...] = (),
) -> int:
    """Write policy.yaml and the shards with their index; weights are drawn and written a part at a time.

    Args:
        out: Directory to write to; made when absent.
        shape: Of the decoder; ``layers`` replaces its number of layers.
        seed: Of the weights: matrices N(0, 1 / fan in), norms 1.
        dtype: Of the stored weights.
        shard_bytes: Size from which a new shard begins.
        holes: Layers whose weights are zeros that take no place on the disk.

    Returns:
        The number of parameters.
    """
    shape = replace(shape, layers=layers or shape.layers)
    with torch.device("meta"):
        module = LlamaPolicy(shape, vocabulary, length)
    out.mkdir(parents=True, exist_ok=True)
    _describe(out, {"shape": asdict(shape), "vocabulary": vocabulary, "length": length})
    shards: list[dict[str, tuple[int, ...]]] = [{}]
    size, width = 0, torch.empty(0, dtype=getattr(torch, dtype)).element_size()
    for name, parameter in module.named_parameters():
        if size >= shard_bytes:
            shards.append({})
            size = 0
        shards[-1][name] = tuple(parameter.shape)
        size += parameter.numel() * width
    placed = {}
    for number, shard in enumerate(shards):
        file = f"model-{number + 1:05}-of-{len(shards):05}.safetensors"
        _write_shard(out / file, shard, seed, dtype, tuple(f"decoder.layers.{number}." for number in holes))
        placed.update(dict.fromkeys(shard, file))
    index = {"metadata": {}, "weight_map": placed}
    (out / "model.safetensors.index.json").write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    return sum(parameter.numel() for parameter in module.parameters())


def _describe(out: Path, arguments: dict[str, Any]) -> None:
    length = arguments["length"]
    content = {
        "schema": 1,
        "name": "llama-like",
        "version": "0.0.0",
        "description": "A decoder shaped like Llama 2 with random weights in safetensors shards.",
        "source": "policy.py:make",
        "arguments": arguments,
        "weights": "*.safetensors",
        "spec": {
            "inputs": [{"name": "ids", "shape": [1, length], "dtype": "int64"}],
            "outputs": [{"name": "action", "shape": [1, CHUNK, JOINTS], "unit": ["rad"] * JOINTS}],
            "control_hz": 5,
            "chunk": CHUNK,
        },
    }
    text = require("yaml", "build").safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    (out / "policy.yaml").write_text(text, encoding="utf-8")
    shutil.copyfile(__file__, out / "policy.py")


def _write_shard(
    file: Path, tensors: dict[str, tuple[int, ...]], seed: int, dtype: str, holes: tuple[str, ...] = ()
) -> None:
    names = {"bfloat16": "BF16", "float16": "F16", "float32": "F32"}
    width = torch.empty(0, dtype=getattr(torch, dtype)).element_size()
    header: dict[str, Any] = {}
    offset = 0
    for name, shape in tensors.items():
        size = math.prod(shape) * width
        header[name] = {"dtype": names[dtype], "shape": list(shape), "data_offsets": [offset, offset + size]}
        offset += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with file.open("wb") as stream:
        stream.write(len(text).to_bytes(8, "little") + text)
        for name, shape in tensors.items():
            if holes and name.startswith(holes):
                stream.truncate(stream.seek(math.prod(shape) * width, os.SEEK_CUR))
                continue
            for part in _drawn(name, shape, seed, dtype):
                stream.write(part.view(torch.uint8).numpy().data)


def _drawn(name: str, shape: tuple[int, ...], seed: int, dtype: str) -> Iterator[Tensor]:
    """Yield the weights of one tensor, flat, in parts."""
    digest = hashlib.sha256(f"{seed}:{name}".encode()).digest()
    stream = torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))
    count, deviation = math.prod(shape), shape[-1] ** -0.5
    for begin in range(0, count, PART):
        part = torch.empty(min(PART, count - begin), dtype=getattr(torch, dtype))
        yield part.fill_(1) if len(shape) == 1 else part.normal_(0, deviation, generator=stream)
