"""ResNet-18 over one camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

DESCRIPTION = (
    "ResNet-18 over one raw 224x224 camera image (uint8 NHWC) with a linear head to 1000 float32 features; "
    "11.7 M parameters, 1.8 G multiply-adds."
)
SPEC: dict[str, object] = {
    "inputs": [
        {"name": "image", "shape": [1, 224, 224, 3], "dtype": "uint8", "unit": "rgb"},
    ],
    "outputs": [
        {"name": "features", "shape": [1, 1000], "dtype": "float32", "unit": "1"},
    ],
    "control_hz": 30,
    "chunk": 1,
}


def make(seed: int = 0, device: str | None = None) -> nn.Module:
    """Return the policy in eval mode.

    Args:
        seed: Seed of the weights.
        device: Where it lives, the CPU when None; ``"meta"`` costs no memory.
    """
    from vlatool.samples._build import build
    from vlatool.samples._convolution import ResNetFeatures

    return build(lambda: ResNetFeatures(), seed, device=device)
