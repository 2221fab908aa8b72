"""A small vision-language-action policy that gives a whole action chunk in one pass."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "Vision-language-action policy: ViT-S/16 on 2 cameras of 224x224, 80 instruction tokens, 6 fusion layers of "
    "width 384, one 16x7 action chunk (float32) in one pass; 45 M parameters."
)
SPEC: dict[str, object] = {
    "inputs": [
        {"name": "image_front", "shape": [1, 224, 224, 3], "dtype": "uint8", "unit": "rgb"},
        {"name": "image_wrist", "shape": [1, 224, 224, 3], "dtype": "uint8", "unit": "rgb"},
        {
            "name": "instruction",
            "kind": "text",
            "shape": [1, 80],
            "dtype": "int64",
            "tokenizer": "vocabulary.json",
            "max_tokens": 80,
        },
    ],
    "outputs": [
        {
            "name": "action",
            "shape": [1, 16, 7],
            "dtype": "float32",
            "labels": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"],
            "unit": ["m", "m", "m", "rad", "rad", "rad", "1"],
            "mode": "delta",
        },
    ],
    "control_hz": 20,
    "chunk": 16,
}


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode.

    Args:
        seed: Seed of the weights.
        device: Where it lives, the CPU when None; ``"meta"`` costs no memory.
    """
    from vlatool.samples._build import build
    from vlatool.samples._fusion import FusionPolicy, FusionShape

    return build(lambda: FusionPolicy(FusionShape()), seed, device=device)
