"""The language part of a policy: one pass of SmolLM2-360M's layers over a prompt."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Prefill of a text decoder shaped like SmolLM2-360M: 113 embeddings of width 960 to hidden states (float32); "
    "315 M parameters in 32 layers with 15 query and 5 key/value heads, SwiGLU 2560."
)
SPEC: dict[str, object] = {
    "inputs": [
        {"name": "embeddings", "shape": [1, 113, 960], "dtype": "float32", "unit": "1"},
    ],
    "outputs": [
        {"name": "hidden", "shape": [1, 113, 960], "dtype": "float32", "unit": "1"},
    ],
    "control_hz": 10,
    "chunk": 113,
    "execute": 1,
}


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode.

    Args:
        seed: Seed of the weights.
        device: Where it lives, the CPU when None; ``"meta"`` costs no memory.
    """
    from vlatool.samples._build import build
    from vlatool.samples._language import SMOLLM2_360M, Prefill

    return build(lambda: Prefill(SMOLLM2_360M, length=113), seed, device=device)
