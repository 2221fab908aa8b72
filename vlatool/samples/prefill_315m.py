"""The language part of a policy: one pass of SmolLM2-360M's layers over a prompt."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vlatool.samples._entries import numbers

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Prefill of a text decoder shaped like SmolLM2-360M: 113 embeddings of width 960 to hidden states (float32); "
    "315 M parameters in 32 layers with 15 query and 5 key/value heads, SwiGLU 2560."
)
SPEC: dict[str, object] = {
    "inputs": [numbers("embeddings", 113, 960)],
    "outputs": [numbers("hidden", 113, 960)],
    "control_hz": 10,
    "chunk": 113,
    "execute": 1,
}


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode; the arguments are those of ``build``."""
    from vlatool.samples._build import build
    from vlatool.samples._language import SMOLLM2_360M, Prefill

    return build(lambda: Prefill(SMOLLM2_360M, length=113), seed, device=device)
